"""A fleet on one machine: real raylets, each with an arbiter and a simulated GPU of its own.

    with Boxes(short_folder, nodes=2) as boxes:
        boxes.connect()                # ray.init of this process
        first, second = boxes.nodes    # `first` is Ray's head too
        boxes.kill(second.name)

Run it under `flock /tmp/heavy.lock` where other programs start raylets. Imports ray late: it takes
seconds, and a test file is collected without it.
"""

import contextlib
import os
import secrets
import signal
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from select import poll
from typing import Any, Final, Self

from tests.support.process import ArbiterProcess
from tests.support.processes import children
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE

ATTEMPTS: Final = 6
"""Ray waits 30 s for a raylet, without a setting: on a busy machine that is too short."""
STORE_BYTES: Final = 80 << 20
MARKER: Final = "vram_arbiter"
"""Static resource of a node with an arbiter."""
ENDED_S: Final = 30.0
VARIABLES: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # it would make an environment anew on each node
    # workers that are started for drivers yet to come cost each node seconds of a core
    "RAY_enable_worker_prestart": "0",
    "RAY_prestart_worker_first_driver": "0",
    # Ray listens on all addresses
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}


@dataclass(slots=True)
class Box:
    """A node of the fleet. `environ`: what a process on it needs to find arbiter and GPU."""

    name: str
    daemon: ArbiterProcess
    environ: Mapping[str, str]
    raylet: Any = field(repr=False)
    """Ray's own `Node`."""

    @property
    def node_id(self) -> str:
        return str(self.raylet.node_id)

    @property
    def gpu_folder(self) -> Path:
        return self.daemon.gpu_folder

    @property
    def raylet_pid(self) -> int:
        return int(self.raylet.all_processes["raylet"][0].process.pid)

    @property
    def pids(self) -> list[int]:
        """The raylet and all that it has started."""
        return descendants([self.raylet_pid])


class Boxes:
    """`nodes` boxes n0, n1 …; all ends with the block.

    `folder` gets Ray's sessions and must be short: the path of a socket holds 107 bytes. `cpus`: of
    each node. `gpu`: as of `vram-arbiter`. `environ`: more variables of all processes of Ray,
    this one included, such as RAY_AUTH_MODE and RAY_AUTH_TOKEN.
    """

    def __init__(
        self,
        folder: Path,
        nodes: int = 2,
        *,
        cpus: int = 2,
        gpu: str = "fake:8GiB",
        environ: Mapping[str, str] | None = None,
    ) -> None:
        self.nodes: list[Box] = []
        self._count, self._cpus, self._gpu = nodes, cpus, gpu
        self._environ = VARIABLES | {"RAY_TMPDIR": str(folder)} | dict(environ or {})
        self._cluster: Any = None
        self._undo = ExitStack()

    def __enter__(self) -> Self:
        with self._undo:  # what has begun ends, if the rest fails
            self._undo.enter_context(_variables(self._environ))
            from ray._private.authentication_test_utils import reset_auth_token_state
            from ray.cluster_utils import Cluster

            reset_auth_token_state()  # Ray reads these variables when it is imported
            self._cluster = Cluster()
            self._undo.callback(self._shutdown)
            for number in range(self._count):
                self.nodes.append(self._start(f"n{number}"))
            self._undo = self._undo.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    @property
    def address(self) -> str:
        """What `ray.init(address=…)` and `--ray` take."""
        return str(self._cluster.address)

    def connect(self, **named: Any) -> None:
        """Let this process be a driver; `named` as of `ray.init`."""
        import ray

        quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
        ray.init(address=self.address, **quiet | named)

    def kill(self, name: str) -> None:
        """SIGKILL raylet, workers and arbiter of a box, as a power cut does. Raises ValueError for
        n0: Ray's head goes with it."""
        (box,) = (one for one in self.nodes if one.name == name)
        if box is self.nodes[0]:
            raise ValueError(f"{name} is Ray's head, and the fleet ends with it")
        with _held(box.pids) as held:
            for process in held:
                signal.pidfd_send_signal(process, signal.SIGKILL)
            box.daemon.kill()
        self._cluster.remove_node(box.raylet, allow_graceful=False)
        self.nodes.remove(box)

    def _start(self, name: str) -> Box:
        daemon = ArbiterProcess(self._gpu, prepared=True)
        self._undo.callback(daemon.close)
        daemon.start()
        environ = {
            "VRAM_ARBITER_RUNTIME": str(daemon.runtime),
            FOLDER_VARIABLE: str(daemon.gpu_folder),
        }
        given: dict[str, Any] = {
            "num_cpus": self._cpus,
            "object_store_memory": STORE_BYTES,
            "resources": {MARKER: 1000},
            "labels": {"box": name},
            "env_vars": environ,
        }
        if not self.nodes:
            given |= {"include_dashboard": False, "no_monitor": True, "include_log_monitor": False}
        return Box(name, daemon, environ, self._add(given))

    def _add(self, given: Mapping[str, Any]) -> Any:
        """Add a node; again where the raylet came too late for Ray."""
        for left in reversed(range(ATTEMPTS)):
            before = set(children(os.getpid()))
            try:
                return self._cluster.add_node(**given)
            except Exception:  # Ray raises no narrower one
                _end(pid for pid in children(os.getpid()) if pid not in before)
                if not left:
                    raise
        raise AssertionError

    def _shutdown(self) -> None:
        import ray

        with _held([pid for box in self.nodes for pid in box.pids]) as held:
            ray.shutdown()
            self._cluster.shutdown()
            _wait(held)


def descendants(pids: Iterable[int]) -> list[int]:
    """Return these processes and all below them, parents first."""
    found = list(pids)
    for pid in found:  # it grows meanwhile
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += children(pid)
    return found


@contextlib.contextmanager
def _held(pids: Iterable[int]) -> Iterator[list[int]]:
    """Yield pidfds: a number may be another process's after a death."""
    with ExitStack() as undo:
        held: list[int] = []
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                held.append(os.pidfd_open(pid))
                undo.callback(os.close, held[-1])
        yield held


def _end(pids: Iterable[int]) -> None:
    """Kill processes and all below them."""
    with _held(descendants(pids)) as held:
        for process in held:
            signal.pidfd_send_signal(process, signal.SIGKILL)
        _wait(held)


def _wait(held: Iterable[int]) -> None:
    """Wait until processes have ended; kill those that take long."""
    for process in held:
        waiter = poll()
        waiter.register(process)
        if not waiter.poll(ENDED_S * 1000):
            signal.pidfd_send_signal(process, signal.SIGKILL)
            waiter.poll()


@contextlib.contextmanager
def _variables(given: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for a block."""
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
