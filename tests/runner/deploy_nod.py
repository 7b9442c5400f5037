"""`vram-runner deploy` with skills of this process instead of sidecars:

`python deploy_nod.py deploy --config …`.
"""

import asyncio
import logging
import os
import sys
from collections.abc import Mapping
from unittest import mock

from tests.runner.small_robots import Nod
from vram_arbiter.runner.__main__ import parse
from vram_arbiter.runner.cli import deploy
from vram_arbiter.runner.cli.deployment import read_deployment
from vram_arbiter.runner.goals.catalogue import Maker
from vram_arbiter.schemas.errors import ConfigError, EstopRequested, VramError
from vram_arbiter.schemas.manifest import Kind

STEPS = os.environ.get("NOD_STEPS")
CAMERAS = tuple(filter(None, os.environ.get("NOD_CAMERAS", "").split(",")))


def makers(*_: object) -> Mapping[Kind, Maker]:
    steps = int(STEPS) if STEPS else None
    return {
        Kind.ROS_ACTION: lambda manifest: Nod(
            manifest, cameras=CAMERAS, steps=steps, all_joints=True
        )
    }


def main() -> int:
    logging.basicConfig(level="INFO", stream=sys.stderr)
    args = parse(None)
    try:
        with mock.patch.object(deploy, "policy_makers", makers):
            return asyncio.run(deploy.Deploy(args, read_deployment(args.config)).run())
    except VramError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, ConfigError | EstopRequested) else 1


if __name__ == "__main__":
    sys.exit(main())
