"""Leased actors for tests of fleets, and what they note of their episodes. A simulated GPU's
allocation log shows whether an eviction fell into one."""

import json
import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vram_arbiter.clients.ray import LeasedSpec, leased
from vram_arbiter.schemas.fakegpu import LOG_FILE
from vram_arbiter.testing.gpu import FakeGpu


class Bare:
    """Has no model, and does nothing when it is called."""

    def load(self) -> None: ...

    def unload(self) -> None: ...

    def ping(self) -> None: ...


class BareAsync(Bare):
    async def ping(self) -> None: ...  # type: ignore[override]


@leased(vram="1GiB", model="calls")
class Caller(Bare): ...


@leased(vram="1GiB", model="calls")
class CallerAsync(BareAsync): ...


class Episodes(Bare):
    """Plays episodes of `seconds`, and notes each in `folder`."""

    leased: LeasedSpec
    lease: Any

    def __init__(self, folder: str, seconds: float) -> None:
        self._folder, self._seconds = Path(folder), seconds

    def load(self) -> None:
        FakeGpu(name="player").allocate(self.leased.need_bytes)

    def unload(self) -> None:
        FakeGpu().free()

    def episode(self, seed: int) -> dict[str, int]:
        begun = time.monotonic()
        note(self._folder, "begun", seed, begun, begun)
        threading.Event().wait(self._seconds)
        note(self._folder, "ended", seed, begun, time.monotonic())
        return {"seed": seed, "pid": os.getpid()}


@leased(vram="5GiB", model="episodes", wait_s=60)
class Player(Episodes):
    """Two do not fit on a simulated GPU of 8 GiB."""


@leased(vram="2GiB", model="small")
class SmallPlayer(Episodes):
    """Three fit."""


def note(folder: Path, what: str, seed: int, begun: float, now: float) -> None:
    """Append one line for this process; another one writes another file."""
    line = {"seed": seed, "pid": os.getpid(), "begun": begun, "t": now}
    with (folder / f"{what}-{os.getpid()}.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")


def noted(folder: Path, what: str) -> list[dict[str, Any]]:
    """Return the lines of all processes."""
    files = sorted(folder.glob(f"{what}-*.jsonl"))
    return [json.loads(line) for file in files for line in file.read_text().splitlines()]


def freed_inside(folder: Path, gpus: Iterable[Path]) -> list[dict[str, Any]]:
    """Return lines of the allocation logs that free a process's bytes inside an episode of it."""
    episodes = noted(folder, "ended")
    found = []
    for gpu in gpus:
        for text in (gpu / LOG_FILE).read_text().splitlines():
            line = json.loads(text)
            if line["op"] in ("free", "cache") and any(
                one["pid"] == line["pid"] and one["begun"] <= line["t"] <= one["t"]
                for one in episodes
            ):
                found.append(line)
    return found
