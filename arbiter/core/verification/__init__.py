"""Verification: did the memory of a released lease return? Three parts, and one record.

`model.verification.Verification` holds one release, expiry or death under measurement.

- `schedule`: when to read, and what follows. `begin_for_lease`, `begin_again`, `on_process_died`,
  `on_reading`, `on_probe_failed`, `on_probe_due`, `on_poll_due`, `stale`.
- `evidence`: what a reading says. `impossible`, `take`, `note_pressure`, `others_since`.
- `judge`: the verdict from one reading, pure. `judge`.

What a source can tell beside the total is derived in `events.MemorySampled` alone
(`lists_processes`, `lists_bytes`, `shows`, `omits`, `bytes_of`).
"""
