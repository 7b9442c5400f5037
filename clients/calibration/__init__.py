"""Measurement of a program's footprint on a GPU, for `vramctl calibrate`: `vramctl run` with a
record.

`gpu` reads a GPU, `record` keeps the bytes of the program and turns them into figures, `model` is
the program that loads and asks the model of a manifest, `entry` writes the footprint file. Must not
import the daemon or the sidecars: both are reached as processes.
"""
