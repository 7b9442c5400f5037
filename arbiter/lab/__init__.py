"""Laboratory: simulation and comparison of scheduling policies, offline."""
