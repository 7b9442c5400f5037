"""The disk of the state folder fills up, under a running daemon and before one starts. A real disk,
or a real limit of the kernel's.

What is held stays held, nothing is granted that could not be recovered, it is said, and it ends
with the trouble.
"""

import contextlib
import os
import resource
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator

import pytest

from tests.support.process import ArbiterProcess, vramctl
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e
BEAT = {"WATCHDOG_USEC": "600000"}
"""The daemon looks after its files at every beat, which this makes 0.2 s."""


class Tmpfs:
    """The state folder lies on a small file system of its own, which a file of ours can fill."""

    def __init__(self, on_small_disk: ArbiterProcess) -> None:
        self._folder = on_small_disk.state
        self._ballast = on_small_disk.state / "ballast"
        on_small_disk.state.mkdir(mode=0o700)
        options = ["-t", "tmpfs", "-o", "size=1m,mode=0700", "none"]
        done = subprocess.run(
            ["mount", *options, str(self._folder)], capture_output=True, text=True, timeout=60
        )
        if done.returncode:
            pytest.skip(f"no small disk can be mounted here: {done.stderr.strip()}")

    def fill(self) -> None:
        with self._ballast.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(b"\0" * 4096)

    def free(self) -> None:
        self._ballast.unlink()

    def remount(self, how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(self._folder)], check=True, timeout=60)

    def close(self) -> None:
        subprocess.run(["umount", str(self._folder)], check=True, timeout=60)


class SizeLimit:
    """The kernel refuses the daemon to write to any file (RLIMIT_FSIZE): needs no privilege."""

    def __init__(self, on_small_disk: ArbiterProcess) -> None:
        self._arbiter = on_small_disk

    def _limit(self, soft: int) -> None:
        resource.prlimit(self._arbiter.pid, resource.RLIMIT_FSIZE, (soft, resource.RLIM_INFINITY))

    def fill(self) -> None:
        self._limit(0)

    def free(self) -> None:
        self._limit(resource.RLIM_INFINITY)

    def close(self) -> None:
        pass


@pytest.fixture
def on_small_disk() -> Iterator[ArbiterProcess]:
    made = ArbiterProcess(config="record:\n  enabled: false\n", prepared=True)
    yield made
    made.close()


@pytest.fixture
def tmpfs(on_small_disk: ArbiterProcess) -> Iterator[Tmpfs]:
    if os.getuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root and mount for a small disk")
    disk = Tmpfs(on_small_disk)
    yield disk
    if on_small_disk.process is not None and on_small_disk.process.poll() is None:
        on_small_disk.kill()
    disk.close()


@pytest.fixture(params=["tmpfs", "limit"])
def disk(on_small_disk: ArbiterProcess, request: pytest.FixtureRequest) -> Tmpfs | SizeLimit:
    if request.param == "tmpfs":
        found: Tmpfs = request.getfixturevalue("tmpfs")
        return found
    return SizeLimit(on_small_disk)


def consumers(client: WireClient) -> list[str]:
    return [lease["consumer"] for lease in client.ask("status")["leases"]]


def kinds_on_disk(on_small_disk: ArbiterProcess) -> set[str]:
    """What a kill would leave of the history; it is written a little after it happened."""
    with contextlib.closing(sqlite3.connect(on_small_disk.state / "history.sqlite")) as database:
        return {kind for (kind,) in database.execute("SELECT DISTINCT kind FROM events")}


def wait_until(client: WireClient, good: Callable[[], bool]) -> None:
    """Look again with every event, and at every beat of the wire at the latest."""
    for _ in range(int(PATIENCE_S / 0.1)):
        if good():
            return
        client.receive(0.1)
    raise AssertionError(f"never: {client.ask('status')}")


def test_a_full_disk_blocks_grants_and_nothing_else(
    on_small_disk: ArbiterProcess, disk: Tmpfs | SizeLimit
) -> None:
    on_small_disk.start(BEAT)
    with WireClient(on_small_disk.endpoint) as client:
        client.hello().ask("subscribe")
        held = [client.granted(name, 200 << 20, ttl_s=600.0) for name in ("stays",)]
        on = {"lease_id": held[0]["lease_id"], "token": held[0]["token"]}
        assert client.ask("ready", **on)["ok"]
        goes = client.granted("goes", 200 << 20, ttl_s=600.0)
        goes_on = {"lease_id": goes["lease_id"], "token": goes["token"]}
        assert client.ask("ready", **goes_on)["ok"]
        disk.fill()
        answer = client.acquire("refused", GIB)
        # it waited for a reading of the GPU
        refused = answer if not answer["ok"] else client.push("denied")
        assert refused["error"]["code"] == "journal_unavailable"
        assert any(
            "journal cannot be written" in problem for problem in client.ask("status")["problems"]
        )
        on_small_disk.wait_for("journal cannot be written", PATIENCE_S)
        doctor = vramctl("doctor", environ=on_small_disk.environ)
        assert doctor.returncode == 1, "a daemon that can grant nothing is not healthy"
        assert "ERROR    daemon.files" in doctor.stdout
        assert sorted(consumers(client)) == ["goes", "stays"]
        assert client.ask("renew", leases=[on])["ok"]

        assert client.ask("unloading", **goes_on)["ok"]
        assert client.ask("release", **goes_on)["ok"]
        # its record could not be deleted
        wait_until(client, lambda: consumers(client) == ["stays"])

        disk.free()
        wait_until(client, lambda: client.ask("status")["problems"] == [])
        client.granted("later", 200 << 20, ttl_s=600.0)
        kinds = {event["kind"] for event in client.ask("history", limit=1000)["events"]}
        assert {"journal_failed", "released", "granted"} <= kinds, sorted(kinds)
        wait_until(client, lambda: "journal_failed" in kinds_on_disk(on_small_disk))
    on_small_disk.kill()
    on_small_disk.start()
    with WireClient(on_small_disk.endpoint) as client:
        client.hello()
        assert sorted(consumers(client)) == ["later", "stays"], (
            "what was released does not come back as a lease"
        )
        events = client.ask("history", kinds=["journal_failed", "denied"], limit=1000)["events"]
        assert {event["kind"] for event in events} >= {"journal_failed"}, (
            "history of the bad time is on disk too"
        )


def test_a_start_on_a_read_only_disk_is_worth_another_try_and_loses_no_lease(
    on_small_disk: ArbiterProcess, tmpfs: Tmpfs
) -> None:
    """Regression: it ended with 2, the code that systemd takes for a person's mistake, and stayed
    down for ever."""
    on_small_disk.start()
    with WireClient(on_small_disk.endpoint) as client:
        client.hello().granted("holder", GIB, ttl_s=600.0)
        client.ask("ping")
    on_small_disk.kill()
    tmpfs.remount("ro")
    for _ in range(2):
        with pytest.raises(RuntimeError, match="ended with 5"):
            on_small_disk.start()
    assert "full, failing or read-only" in on_small_disk.log
    assert "Traceback" not in on_small_disk.log
    tmpfs.remount("rw")
    on_small_disk.start()
    with WireClient(on_small_disk.endpoint) as client:
        assert consumers(client.hello()) == ["holder"]
        assert not client.ask("status")["problems"], "and nothing was taken for damage"


def test_a_restart_on_a_full_disk_is_worth_another_try_and_loses_no_lease(
    on_small_disk: ArbiterProcess, tmpfs: Tmpfs
) -> None:
    """Regression: it ended with a traceback, or with an exit code for wrong configuration, which
    systemd does not retry."""
    on_small_disk.start()
    with WireClient(on_small_disk.endpoint) as client:
        held = client.hello().granted("stays", 200 << 20, ttl_s=600.0)
    on_small_disk.kill()
    tmpfs.fill()
    with pytest.raises(RuntimeError, match="ended with 5"):
        on_small_disk.start()
    assert "on a disk that is full, failing or read-only" in on_small_disk.log
    assert "Traceback" not in on_small_disk.log
    tmpfs.free()
    on_small_disk.start()
    with WireClient(on_small_disk.endpoint) as client:
        (lease,) = client.hello().ask("status")["leases"]
        assert (lease["lease_id"], lease["token"]) == (held["lease_id"], held["token"])
