"""Scheduling: which request is granted next on which GPU, and which holders are revoked for it.

- `grants`: one pass over the GPUs that changed. `schedule`, `grant`, backfill.
- `admission`: candidate GPUs, and whether a request fits on one, by ledger and by reading.
- `victims`: which holders make room, and on which of several GPUs.
"""
