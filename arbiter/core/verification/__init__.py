"""Verification: did the memory of a released lease return?

`model.lease.Verification` holds one release, expiry or death under measurement.

- `schedule`: when to read, and what follows. `begin_for_lease`, `on_process_died`, `on_reading`,
  `on_probe_failed`, `on_probe_due`, `on_poll_due`, `stale`.
- `judge`: the verdict. `others_since`, `judge`.
"""
