"""`vram-runner ros2`: serve a running runner's goals as ROS 2 actions, and publish its state."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib.util

from vram_arbiter.clients.cli.arguments import positive
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.client import add_client_flags, client_of, note
from vram_arbiter.runner.cli.common import install_signals
from vram_arbiter.runner.ros2.goal_action import INTERFACE, NAME, RunnerGoals
from vram_arbiter.runner.sensors.ros2_dds import domain_of
from vram_arbiter.runner.skills.ros_standins import TRAJECTORY
from vram_arbiter.schemas.errors import ConfigError, InternalError

SERVES = True
STATE_HZ = 20.0


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner ros2`."""
    ros2 = commands.add_parser(
        "ros2",
        help="serve a running runner's goals as a ROS 2 action, and publish its state",
        description=f"Serves {INTERFACE} on ROS_DOMAIN_ID, and publishes joint states and tf. Every"
        " participant of that DDS domain may move the robot: CYCLONEDDS_URI chooses its network.",
    )
    ros2.add_argument("--action", default=NAME, metavar="NAME", help="default %(default)s")
    ros2.add_argument(
        "--trajectories",
        metavar="RSKILL",
        help="serve control_msgs/FollowJointTrajectory by this skill, under its interface_name",
    )
    ros2.add_argument(
        "--state-hz",
        type=positive,
        default=STATE_HZ,
        metavar="HZ",
        help="publish /joint_states and /tf at most so often; default %(default)g",
    )
    add_client_flags(ros2)
    return ros2


async def run(args: argparse.Namespace) -> int:
    """Serve until a signal; goals that run are canceled then. Raises ConfigError: DDS is missing or
    cannot be started; InternalError: it failed later; and what the client raises."""
    if importlib.util.find_spec("cyclonedds") is None:
        raise ConfigError("Cyclone DDS is not installed", hint="pip install 'vram-arbiter[ros2]'")
    from vram_arbiter.runner.ros2.action_server import ActionServer
    from vram_arbiter.runner.ros2.state_topics import StateTopics
    from vram_arbiter.runner.ros2.trajectory_action import TrajectoryGoals, action_name

    try:
        domain = domain_of()
    except ValueError as error:
        raise ConfigError(str(error)) from error
    stopping = asyncio.Event()
    install_signals(stopping)
    async with client_of(args) as client, contextlib.AsyncExitStack() as stack:
        await client.state()  # a runner answers
        served = [(INTERFACE, args.action, RunnerGoals(client).accept)]
        if (rskill_id := args.trajectories) is not None:
            accept = TrajectoryGoals(client, rskill_id).accept
            served.append((TRAJECTORY, await action_name(client, rskill_id), accept))
        publishing = asyncio.create_task(StateTopics(client, domain, args.state_hz).run())
        stack.push_async_callback(_ended, publishing)
        publishing.add_done_callback(lambda _: stopping.set())
        servers = [
            await stack.enter_async_context(ActionServer(interface, name, domain, accept))
            for interface, name, accept in served
        ]
        for server in servers:
            note(f"serving goals of {client.endpoint} as {server.name} on DDS domain {domain}")
            server.failed.add_done_callback(lambda _: stopping.set())
        await stopping.wait()
        for server in servers:
            if server.failed.done():
                raise InternalError(f"DDS failed: {server.failed.result()}", hint="see the log")
    return 0


async def _ended(task: asyncio.Task[None]) -> None:
    """Cancel a task. Raises what it raised."""
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
