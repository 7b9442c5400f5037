"""`vramctl remote`: a robot's tunnel to a GPU server, over OpenSSH."""

import argparse
from typing import Final

from vram_arbiter.clients.cli import authorize

DESCRIPTIONS = {
    "remote": "Use the models of a GPU server from a robot: its arbiter and its sidecars, over "
    "OpenSSH. The server's arbiter takes the robot as a guest, which marks uses and holds no lease."
}
ACTIONS: Final = {
    "authorize": "On the server: let a robot's key in, for the arbiter, the sidecars and the doors "
    "that are named. Shows what the robot may then do, and what not.",
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    commands = parser.add_subparsers(metavar="ACTION", required=True)
    for name, add in (("authorize", authorize.add),):
        add(commands.add_parser(name, help=ACTIONS[name], description=ACTIONS[name]))


def run(args: argparse.Namespace) -> int:
    return int(args.action(args))
