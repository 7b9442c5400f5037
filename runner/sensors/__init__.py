"""Cameras: one reader a camera, all with the face of `runner.protocols.SensorReader`.

A reader takes frames in on a thread of its own and leaves the newest in a `LatestSlot`; the control thread picks it up there and never
waits for a camera. What no camera gave is never served: no frame, an old frame and a broken source are all `FrameStale`.
"""

from vram_arbiter.runner.sensors.slot import Feed, FrameTee, LatestSlot, SlotReader

__all__ = ["Feed", "FrameTee", "LatestSlot", "SlotReader"]
