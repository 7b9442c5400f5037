"""Cameras: one reader per camera, all as `runner.protocols.SensorReader`.

A reader takes frames in on a thread of its own and leaves the newest in a `LatestSlot`; the control
thread never waits for a camera. No frame, an old frame and a broken source are all `FrameStale`.
"""

from vram_arbiter.runner.sensors.slot import Feed, FrameTee, LatestSlot, SlotReader

__all__ = ["Feed", "FrameTee", "LatestSlot", "SlotReader"]
