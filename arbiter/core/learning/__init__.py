"""Learned footprints, durations and crash backoff."""
