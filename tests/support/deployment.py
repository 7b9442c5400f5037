"""Deployment files as texts of tests."""

from vram_arbiter.schemas.config.robot import RobotEnvironment, robot_of
from vram_arbiter.schemas.yamltext import parse_yaml


def load_robot(text: str, name: str = "robot.yaml") -> RobotEnvironment:
    """Read the text of a deployment file; `name` is how errors call it."""
    return robot_of(parse_yaml(text, name))
