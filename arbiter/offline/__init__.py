"""Recorded event logs, read offline: `vramctl replay` and `vramctl timeline`.

The daemon imports none of it.
"""
