"""The daemon's log, spans and metrics."""
