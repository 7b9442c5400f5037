"""Robots and their twins behind `base.HalBase`; `factory.make_hal` makes one from a file.

Joint units are rad and rad/s, efforts N·m; the adapter converts what the hardware speaks (degrees,
0–100).
"""
