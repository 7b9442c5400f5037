"""A lease owns a process tree, and a cgroup: a real daemon, the real `vramctl run`, and a child
that puts its bytes on the simulated GPU."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.prepared import Forked
from tests.support.process import ArbiterProcess
from tests.support.running import running
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.runtime import procfs

pytestmark = pytest.mark.e2e

CHILD = """
import os, sys
from pathlib import Path
from vram_arbiter.sidecars.device.fake import FakeMemory
memory = FakeMemory(Path(sys.argv[1]), "job")
memory.allocate("weights", int(sys.argv[2]) - (450 << 20))
print(os.getpid(), flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def quick_reader(
    make_arbiter: Callable[..., ArbiterProcess], request: pytest.FixtureRequest
) -> ArbiterProcess:
    """Reads its GPU ten times a second, and waits for bytes for a minute, or as long as `indirect`
    parametrization says."""
    timeout_s = getattr(request, "param", 60)
    return make_arbiter(
        config=f"probe: {{period_s: 0.1}}\nverify: {{timeout_s: {timeout_s}}}\n"
    ).start()


@pytest.fixture
def watcher(quick_reader: ArbiterProcess) -> Iterator[WireClient]:
    """A connected client: the GPU is read in the background while there is one."""
    with WireClient(quick_reader.endpoint) as client:
        yield client.hello("watcher", role="observer")


@contextlib.contextmanager
def job(quick_reader: ArbiterProcess, size: int, *extra: str) -> Iterator[tuple[Forked, int]]:
    """`vramctl run` of a child that holds `size` until its stdin closes: (vramctl, the child's
    pid)."""
    child = [sys.executable, "-c", CHILD, str(quick_reader.gpu_folder), str(size)]
    words = ("run", "--vram", "5GiB", "--name", "job", "--", *extra, *child)
    with running("vramctl", words, quick_reader.environ) as run:
        yield run.process, int(run.line())
        run.tell()  # the child ends, and vramctl with it
        run.ended()


def gpu_when(watcher: WireClient, when: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The GPU's view as soon as it is like that. Every answer of the daemon paces the questions;
    raises TimeoutError."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        gpu: dict[str, Any] = watcher.ask("status")["gpus"][0]
        if when(gpu):
            return gpu
        watcher.receive(0.05)
    raise TimeoutError(f"the GPU stays {gpu}")


def told(watcher: WireClient, *kinds: str) -> list[dict[str, Any]]:
    events: list[dict[str, Any]] = watcher.ask("history", kinds=list(kinds))["events"]
    return events


def wait_told(
    watcher: WireClient, kind: str, where: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    event: dict[str, Any] = watcher.push(
        "event", PATIENCE_S, lambda push: push["event"]["kind"] == kind and where(push["event"])
    )["event"]
    return event


THROUGH_SHELL = ["sh", "-c", '"$@"; exit $?', "sh"]


def test_the_bytes_of_a_grandchild_are_those_of_the_lease(
    quick_reader: ArbiterProcess, watcher: WireClient
) -> None:
    assert watcher.ask("subscribe")["ok"]
    with job(quick_reader, 4 * GIB, *THROUGH_SHELL) as (vramctl, child):
        gpu = gpu_when(
            watcher, lambda gpu: any(process["used_bytes"] for process in gpu["processes"])
        )
        (process,) = gpu["processes"]
        assert child != vramctl.pid
        assert (process["pid"], process["used_bytes"], process["stowaway"]) == (
            vramctl.pid,
            4 * GIB,
            False,
        )
        assert process["name"].endswith(" (job)")
        assert (gpu["charged_bytes"], gpu["stowaway_bytes"], gpu["pressure_bytes"]) == (
            5 * GIB,
            0,
            0,
        )
    verified = wait_told(watcher, "verified", lambda event: event["consumer"] == "job")
    assert (verified["verdict"], verified["before_bytes"]) == ("verified", 4 * GIB)
    gpu = gpu_when(watcher, lambda gpu: not gpu["charged_bytes"])
    assert gpu["stowaway_bytes"] == 0
    assert told(watcher, "stowaway", "pressure", "lost") == []
    assert vramctl.returncode == 0


@pytest.mark.parametrize("quick_reader", [2], indirect=True)
def test_the_child_of_a_killed_owner_is_a_stowaway_and_contests_its_debt(
    quick_reader: ArbiterProcess, watcher: WireClient
) -> None:
    """The program itself dies with `vramctl`, here a shell; what it started does not."""
    assert watcher.ask("subscribe")["ok"]
    with job(quick_reader, 4 * GIB, *THROUGH_SHELL) as (vramctl, child):
        gpu_when(watcher, lambda gpu: any(process["used_bytes"] for process in gpu["processes"]))
        vramctl.send_signal(signal.SIGKILL)
        stowaway = wait_told(watcher, "stowaway", lambda event: event["pid"] == child)
        assert (stowaway["name"], stowaway["used_bytes"]) == ("job", 4 * GIB)
        verdict = wait_told(watcher, "verified", lambda event: event["consumer"] == "job")
        assert verdict["verdict"] == "contested"
        assert verdict["culprits"] == [{"pid": child, "name": "job", "bytes": 4 * GIB}]
        gpu = gpu_when(watcher, lambda gpu: not gpu["charged_bytes"])
        assert gpu["stowaway_bytes"] == 4 * GIB, (
            "charged once: the debt is over, the orphan is still there"
        )
    gpu_when(watcher, lambda gpu: not gpu["stowaway_bytes"])


HOLDER = """
import sys
from vram_arbiter import Client
with Client("llm") as client, client.lease(vram="5GiB", cgroup=sys.argv[1]) as lease:
    lease.ready()
    print(lease.lease_id, flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def cgroup() -> Iterator[Path]:
    """The folder of a new cgroup, below this process's own."""
    root = procfs.cgroup_root()
    if root is None:
        pytest.skip("no cgroup v2 hierarchy is mounted")
    folder = root / procfs.read_cgroup(os.getpid())[1:] / f"vram-test-{os.getpid()}"
    try:
        folder.mkdir()
    except OSError as error:
        pytest.skip(f"no cgroup can be made: {error}")
    yield folder
    folder.rmdir()


def test_the_bytes_of_a_cgroup_are_those_of_the_lease_that_names_it(
    quick_reader: ArbiterProcess, watcher: WireClient, cgroup: Path
) -> None:
    """The job does not descend from the holder. Its bytes, there before the lease, are not counted
    twice; a sibling's stay a stowaway's."""
    root = procfs.cgroup_root()
    assert root is not None
    python = [sys.executable, "-c"]
    into = ["sh", "-c", f'echo $$ >{cgroup}/cgroup.procs && exec "$@"', "sh"]
    job = [*python, CHILD, str(quick_reader.gpu_folder), str(4 * GIB)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with contextlib.ExitStack() as ending:
        inside = ending.enter_context(subprocess.Popen([*into, *job], **pipes))
        gpu_when(watcher, lambda gpu: gpu["stowaway_bytes"] == 4 * GIB)
        holder = ending.enter_context(
            subprocess.Popen(
                [*python, HOLDER, f"/{cgroup.relative_to(root)}"], env=quick_reader.environ, **pipes
            )
        )
        lease_id = holder.stdout.readline().strip()
        gpu = gpu_when(watcher, lambda gpu: not gpu["stowaway_bytes"])
        (process,) = gpu["processes"]
        assert (process["pid"], process["used_bytes"], process["lease_ids"]) == (
            holder.pid,
            4 * GIB,
            [lease_id],
        )
        assert process["name"] == "llm (job)"
        assert (gpu["charged_bytes"], gpu["pressure_bytes"]) == (5 * GIB, 0)
        for ended in (inside, holder):  # the job's bytes go, then its lease
            ended.communicate("\n", PATIENCE_S)
    gpu_when(watcher, lambda gpu: not gpu["charged_bytes"])
    assert told(watcher, "pressure", "lost") == []
