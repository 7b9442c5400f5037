"""Everything that a daemon meets, simulated in one process under one seed; see `world`."""
