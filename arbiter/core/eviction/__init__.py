"""The eviction ladder."""
