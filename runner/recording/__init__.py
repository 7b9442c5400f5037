"""Goals recorded as a LeRobotDataset v3: every tick a frame, with the trace and span that it belongs to.

The control thread hands ticks over (`recorder`), a process of its own writes them (`writer`), through lerobot's own class
(`lerobot_files`); what is finished is committed (`commit`), and read back by `reader` without lerobot.
"""
