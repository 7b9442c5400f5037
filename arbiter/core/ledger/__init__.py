"""Bytes of one GPU."""
