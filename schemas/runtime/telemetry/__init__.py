"""Telemetry names, set-up and spans."""
