"""Records of the engine, each written by one owner.

- `lease`: `Request` (how a lease was asked for, and its wait), `Lease` (granted), `Departure` (from
  the first revoke to the release), `Verification` (to the verdict), `Observed` (bytes by report and
  reading), `Uses`; the states and the one table of their transitions. `Lease.move` and
  `Lease.recovered` are the only ways to a state.
- `gpu`: `Gpu`, its leases by state (`Residents`), its requests by priority (`WaitQueue`).
- `state`: `Core`, the tables of all records; `Turn`, what the steps of one event tell each other.
- `records`: what the journal keeps. `refusals`: why a request cannot be done.
"""
