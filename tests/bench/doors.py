"""`make bench-doors`: how long robots at a sidecar's doors wait for actions while one process
attacks.

Robots ask ten times a second by openpi's stock client, or by lerobot's messages. What they wait for
is the shipped policy on the CPU, which is the floor. Writes `out/bench/doors.json`.
"""

import argparse
import functools
import os
import pickle
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.harness import Suite, elapsed_us, p50, pause
from tests.sidecars.doors.conftest import GRAB, KEY, Served, two_doors
from tests.sidecars.doors.test_lerobot_door import Peer
from vram_arbiter.schemas.defaults import MIB

PERIOD_S = 0.1
P99_MAX_US = 50_000.0
CHUNK, JOINTS = 12, 6
HOST = "127.0.0.1"


class Openpi:
    """A stock client of openpi."""

    def __init__(self, port: int) -> None:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy

        self.client = WebsocketClientPolicy(HOST, port, api_key=KEY)
        picture: Any = np.zeros((96, 96, 3), np.uint8)
        self.seen = {
            "observation/images": {"front": picture, "wrist": picture},
            "observation/state": np.linspace(-1, 1, JOINTS),
            "prompt": "grab the red cube",
        }

    def act(self) -> None:
        assert self.client.infer(self.seen)["actions"].shape == (CHUNK, JOINTS)

    def sends(self, data: bytes) -> None:
        self.client._ws.send(data)
        self.client._ws.recv(PERIOD_S)

    def close(self) -> None:
        self.client._ws.close()


class Lerobot:
    """lerobot's messages, on a connection of its own."""

    def __init__(self, port: int) -> None:
        from lerobot.async_inference.helpers import RemotePolicyConfig

        self.peer = Peer(f"{HOST}:{port}")
        names = [f"joint_{number}" for number in range(JOINTS)]
        picture = {"dtype": "image", "shape": (96, 96, 3), "names": ["height", "width", "channels"]}
        features = {
            "observation.state": {"dtype": "float32", "shape": (JOINTS,), "names": names},
            **{f"observation.images.{name}": picture for name in ("front", "wrist")},
        }
        self.seen = {
            **dict.fromkeys(names, 0.0),
            **{name: np.zeros((96, 96, 3), np.uint8) for name in ("front", "wrist")},
            "task": "grab the red cube",
        }
        config: Any = RemotePolicyConfig("act", GRAB, features, CHUNK)
        assert self.peer.instruct(config) == "OK"
        self.step = 0

    def sends(self, *pieces: bytes) -> str:
        return self.peer.observe(iter([*((2, piece) for piece in pieces), (3, b"")]))

    def act(self) -> None:
        from lerobot.async_inference.helpers import TimedObservation

        self.step += 1
        observation = TimedObservation(time.time(), self.step, self.seen, must_go=True)
        assert self.sends(pickle.dumps(observation)) == "OK"
        assert self.peer.stub.GetActions(self.peer.messages.Empty()).data

    def close(self) -> None:
        self.peer.channel.close()


class Hostile:
    def __reduce__(self) -> Any:
        return os.getpid, ()


def connects(port: int) -> None:
    socket.create_connection((HOST, port)).close()


def begins(port: int) -> None:
    """A request that does not go on."""
    held = [socket.create_connection((HOST, port)) for _ in range(64)]
    for one in held:
        with suppress(OSError):
            one.send(b"GET / HTTP/1.1\r\nHost: x\r\n")
    pause(1.0)
    for one in held:
        one.close()


def sent(kind: type[Openpi] | type[Lerobot], *data: bytes) -> Callable[[int], None]:
    """Return an attack: a connection of its own sends one thing."""

    def send(port: int) -> None:
        peer = kind(port)
        try:
            peer.sends(*data)
        finally:
            peer.close()

    return send


def instructs(port: int) -> None:
    peer = Lerobot(port)
    try:
        peer.peer.instruct(Hostile())
    finally:
        peer.close()


ATTACKS: Mapping[str, Mapping[str, Callable[[int], None]]] = {
    "openpi": {
        "connections": connects,
        "heads that do not end": begins,
        "maps that lack everything": sent(Openpi, b"\x80"),
        "a million values": sent(Openpi, b"\x81\xa1a\xdd\x00\x0f\xff\xff" + b"\x80" * (MIB - 1)),
        "messages that are too big": sent(Openpi, bytes(24 * MIB)),
    },
    "lerobot": {
        "connections": connects,
        "heads that do not end": begins,
        "pickles that would run": instructs,
        "observations that would run": sent(Lerobot, pickle.dumps(Hostile())),
        "observations that are too big": sent(Lerobot, *[bytes(2 * MIB)] * 9),
    },
}


def repeated(door: str, name: str, port: int, seconds: float) -> None:
    once = functools.partial(ATTACKS[door][name], port)
    with suppress(Exception):  # refused, as it should be
        once()  # imports
    print("up", flush=True)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        with suppress(Exception):
            once()


def waits(robot: Openpi | Lerobot, seconds: float) -> list[float]:
    """Ask at PERIOD_S, and return what each answer took in µs."""
    samples, began_s = [], time.monotonic()
    while time.monotonic() < began_s + seconds:
        samples.append(elapsed_us(robot.act))
        pause(PERIOD_S - (time.monotonic() - began_s) % PERIOD_S)
    return samples


def measured(suite: Suite, door: str, served: Served) -> None:
    robot = Openpi(served.port) if door == "openpi" else Lerobot(served.port)
    seconds = float(suite.size(20, 3))
    waits(robot, 2.0)
    calm = waits(robot, seconds)
    suite.limit(f"{door}, calm", calm, p99_max_us=P99_MAX_US)
    for name in ATTACKS[door]:
        words = ("--attack", door, name, str(served.port), str(seconds + 1))
        attacker = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.doors", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert attacker.stdout is not None
        attacker.stdout.readline()
        samples = waits(robot, seconds)
        attacker.wait()
        attacker.stdout.close()
        added = f"{(p50(samples) - p50(calm)) / 1000:+.1f} ms to the median"
        suite.limit(f"{door}, {name}", samples, p99_max_us=P99_MAX_US, note=added)
    robot.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--only", choices=[*ATTACKS], help="one door")
    parser.add_argument("--attack", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path("out/bench/doors.json"))
    options = parser.parse_args()
    if options.attack:
        door, name, port, seconds = options.attack
        repeated(door, name, int(port), float(seconds))
        return 0
    suite = Suite(quick=options.quick)
    with two_doors() as doors:
        for door in [options.only] if options.only else ATTACKS:
            measured(suite, door, doors[door])
    suite.write(options.out)
    print(f"{suite.table()}\nrows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
