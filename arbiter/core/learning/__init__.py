"""Learned footprints (`footprints`), durations, returns, switches and failed loads (`costs`)."""
