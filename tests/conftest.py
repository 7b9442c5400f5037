"""For every test of the product: a real arbiter daemon in a folder of its own, and Hypothesis's
profiles."""

import gc
import logging
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.support import machines
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient

pytest_plugins = ["tests.support.leftovers", "vram_arbiter.testing.plugin"]
_ROOT = Path(__file__).parents[1]
machines.register()
# Programs that tests start would compile all that they import, each time.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Programs that tests start import `tests.support` too.
os.environ["PYTHONPATH"] = os.pathsep.join(
    [f"{_ROOT}/src", str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
)
# Several workers keep the cores busy: threads of a library would only wait for each other. OpenMP
# reads it when it is first used.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# MuJoCo reads it when it is first imported, by whichever test of this process that is.
os.environ.setdefault("MUJOCO_GL", "egl")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts what runs in its background deaf to SIGINT, and so would be every program that
    # a test interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)


LONGEST = (
    "tests/e2e/test_demo.py",
    "tests/runner/recording/",
    "tests/e2e/",
    "tests/sidecars/",
    "tests/packaging/",
    "tests/testing/",
    "tests/runner/sensors/test_gstreamer.py",
    "tests/runner/skills/test_policies_as_lerobot.py",
    "tests/runner/robots/test_lerobot_robot.py",
    "tests/runner/cli/",
    "tests/runner/benchmark/",
    "tests/bench/",
    "tests/clients/observer/",
    "tests/clients/selftest/",
    "tests/arbiter/core/test_machine.py",
    "tests/arbiter/test_",
)
"""Where the longest tests are: begun last, one worker would end minutes after the other."""


IMPORTING = (
    "tests/sidecars/adapters/",
    "tests/sidecars/doors/",
    "tests/sidecars/test_check.py",
    "tests/sidecars/test_quantization.py",
    "tests/sidecars/test_weights.py",
    "tests/runner/recording/test_recorder.py",
    "tests/runner/robots/test_lerobot_robot.py",
    "tests/runner/robots/test_so101_bus.py",
    "tests/runner/robots/test_teleoperation.py",
    "tests/runner/skills/test_policies_as_lerobot.py",
    "tests/training/",
)
"""Where tests import torch, transformers and lerobot: for one worker, because each that imports
them takes 15 s of a core for it."""


@pytest.hookimpl(optionalhook=True)  # `make mutation` runs without xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each worker one file after another, as `--dist loadfile` does, and one of them all of
    IMPORTING."""
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "importing" if nodeid.startswith(IMPORTING) else super()._split_scope(nodeid)

    return ByFile(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files; the order within a file stays."""

    def rank(item: pytest.Item) -> int:
        path = str(item.path).removeprefix(f"{_ROOT}/")
        found = (place for place, prefix in enumerate(LONGEST) if path.startswith(prefix))
        return next(found, len(LONGEST))

    items.sort(key=rank)


def pytest_collection() -> None:
    """Collect no garbage while modules and items are made, which stay: scanning them takes a second
    of each worker."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over modules and items from now on, too: up to 7 % of a test's
    time."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def own_log() -> Iterator[None]:
    """A program that a test runs in this process sets up the log of the whole process: no test is
    to see more or less for it."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    yield
    root.setLevel(level)
    for handler in [handler for handler in root.handlers if handler not in handlers]:
        root.removeHandler(handler)


@pytest.fixture(scope="session")
def arbiter_process() -> Callable[..., ArbiterProcess]:
    """Daemons of `make_arbiter`: forked."""
    return partial(ArbiterProcess, prepared=True)


@pytest.fixture
def arbiter_daemon(make_arbiter: Callable[..., ArbiterProcess]) -> ArbiterProcess:
    """A running daemon with one simulated GPU of 8 GiB."""
    return make_arbiter().start()


@pytest.fixture
def connect(arbiter_daemon: ArbiterProcess) -> Iterator[Callable[..., WireClient]]:
    """`connect()` makes a bare connection to `arbiter_daemon` (no hello yet)."""
    made: list[WireClient] = []

    def make(**options: Any) -> WireClient:
        made.append(WireClient(arbiter_daemon.endpoint, **options))
        return made[-1]

    yield make
    for client in made:
        client.close()


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """An empty folder with a short path: the path of a socket holds 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="va") as made:
        yield Path(made)


@pytest.fixture
def anyio_backend() -> str:
    """The event loop of asynchronous tests, where a test does not name others."""
    return "asyncio"
