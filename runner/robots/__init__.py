"""Robots and their twins behind `runner.protocols.Hal`. `factory.make_hal` turns the `hal` section of a deployment file into one.

Joint units are rad and rad/s here, efforts N·m; what the hardware speaks (degrees, 0–100) is turned into that by its adapter.
"""
