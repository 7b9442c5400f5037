"""A robot without hardware, as a third-party package of lerobot brings one: lerobot finds it by its
name and its metadata.
"""

from .config_memory import MemoryRobotConfig
from .memory import MemoryRobot

__all__ = ["MemoryRobot", "MemoryRobotConfig"]
