"""Records of the engine, each written by one owner.

- `lease`: `Request` (how a lease was asked for, and its wait), `Lease` (granted), `Departure` (from
  the first revoke to the verdict), `Observed` (bytes by report and reading), `Uses`; the states and
  the one table of their transitions. `Lease.move` and `Lease.recovered` are the only ways to a
  state.
- `residents`: the leases of one GPU by state. `state`: `Gpu` and `Core`, the tables of all records.
- `turn`: what the steps of one event tell each other.
"""
