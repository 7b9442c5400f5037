"""Goals recorded as a LeRobotDataset v3: one frame per tick, with its trace and span.

The control thread hands ticks over (`recorder`), a separate process writes them (`writer`) through
lerobot's own class (`lerobot_files`); finished episodes are committed (`commit`) and read back by
`reader` without lerobot.
"""
