"""`vramctl selftest`: what the product claims of a GPU, measured on the one of this machine.

`bed` is the place of a run (a private daemon and its children), `rows` what is measured there,
`run` goes through the rows, `report` writes what they found. Must not import the daemon or the
sidecars: they are started as programs.
"""
