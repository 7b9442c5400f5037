"""Measurement of a program's footprint on a GPU, for `vramctl calibrate`.

`gpu` reads a GPU, `series` turns readings into figures, `measure` runs a program under observation,
`requests` are what a model is asked meanwhile, `entry` writes the footprint file. Must not import
the daemon or the sidecars: both are reached as processes.
"""
