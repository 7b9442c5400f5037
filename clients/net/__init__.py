"""Connections of clients and programs' servers."""
