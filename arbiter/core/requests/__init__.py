"""Requests of clients and operators, sessions, recovery."""
