"""The lease engine: synchronous, deterministic, no I/O. Events in, effects out; time comes in as
`now`."""
