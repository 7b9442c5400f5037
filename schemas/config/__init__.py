"""Configuration files as models."""
