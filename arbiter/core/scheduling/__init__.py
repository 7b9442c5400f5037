"""Scheduling: which request is granted next on which GPU. Holders are revoked for it by `eviction`.

- `grants`: one pass over the GPUs that changed. `schedule`, `grant`, backfill.
- `admission`: candidate GPUs, and whether a request fits on one, by ledger and by reading.
- `deadlock`: waits that can never end. `resolve`.
"""
