"""Scheduling: which request is granted next on which GPU, and which holders are revoked for it.

- `grants`: one pass over the dirty GPUs. `schedule`, `grant`, `grant_if_measured`, `on_plan_due`.
- `queue`: order of the requests of one GPU. `WaitQueue`.
- `admission`: whether a request fits, by ledger and by reading.
- `victims`: which holders make room. `choose_victims`, `choose_relief`.
- `backfill`: a later request that cannot delay the head. `choose`.
- `placement`: candidate GPUs, and which of several is emptied. `selected`, `places`, `front`.
- `deadlock`: waits that can never end. `resolve`.
- `policies`: named variations of order, backfill and choice.
"""
