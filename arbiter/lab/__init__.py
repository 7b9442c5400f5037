"""The event log: what it looks like, how it is replayed, and what another policy would have made of it."""
