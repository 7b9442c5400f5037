"""The daemon as systemd starts it: the unit's own command line, the folders and sockets that a
manager hands over, a manager's stop and restart, and the unit's restrictions as far as they can be
had without a manager. Real processes; no systemd is run.
"""

import ctypes
import grp
import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.children import spawn
from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e
NOBODYS_GID = 1  # `daemon` or `bin`, which no user is in
UNIT = ROOT / "configs" / "systemd" / "system" / "vram-arbiter.service"


class Service(ArbiterProcess):
    """A daemon that gets its command line from the unit and everything else from the environment,
    as a service does."""

    def __init__(self, options: str, group: str) -> None:
        super().__init__(prepared=True)
        self.endpoint = f"ipc://{self.runtime}/run/arbiter.sock"
        self.gpu_folder = self.runtime / "run" / "fakegpu"
        self.options = options
        self.group = group
        self.wrapper: list[str] = []
        for name, mode in (("run", 0o1770), ("lib", 0o700), ("etc", 0o755)):
            (self.runtime / name).mkdir()
            (self.runtime / name).chmod(mode)  # whatever the umask is

    @property
    def environ(self) -> dict[str, str]:
        environ = super().environ
        del environ["VRAM_ARBITER_RUNTIME"]
        return environ | {
            "RUNTIME_DIRECTORY": f"{self.runtime}/run",
            "STATE_DIRECTORY": f"{self.runtime}/lib",
            "CONFIGURATION_DIRECTORY": f"{self.runtime}/etc",
            "WATCHDOG_USEC": "3000000",
        }

    def command(self, *more: str) -> list[str]:
        (line,) = [line for line in UNIT.read_text().splitlines() if line.startswith("ExecStart=")]
        words = shlex.split(
            line.removeprefix("ExecStart=").replace("$ARBITER_OPTIONS", self.options)
        )
        assert Path(words[0]).name == "vram-arbiter"
        # of this machine: no holder here is a guest
        groups = dict.fromkeys(("vram-arbiter", "vram-operators"), self.group)
        groups["vram-guests"] = grp.getgrgid(NOBODYS_GID).gr_name
        named = [groups.get(word, word) for word in words[1:]]
        return [*self.wrapper, sys.executable, "-m", "vram_arbiter.arbiter", *named, *more]


@pytest.fixture
def service() -> Iterator[Service]:
    made = Service("--gpu fake:8GiB", grp.getgrgid(os.getgid()).gr_name)
    yield made
    made.close()


def test_the_units_command_line_serves_where_the_manager_says(service: Service) -> None:
    (service.runtime / "etc" / "arbiter.yaml").write_text("gpu:\n  reserve_bytes: 1GiB\n")
    service.start()
    assert "STATUS=serving Simulated GPU" in service.messages[-1]
    service.wait_for("WATCHDOG=1", PATIENCE_S)
    socket = service.runtime / "run" / "arbiter.sock"
    assert stat.S_IMODE(socket.stat().st_mode) == 0o660
    assert socket.stat().st_gid == os.getgid()
    assert stat.S_IMODE(socket.parent.stat().st_mode) == 0o1770, "as the manager made it"
    with WireClient(service.endpoint) as client:
        status = client.hello(role="operator").ask("status")
        assert status["gpus"][0]["reserve_bytes"] == GIB, (
            "arbiter.yaml of the configuration folder is read"
        )
    assert (service.runtime / "lib" / "journal.sqlite").exists()
    assert service.stop() == 0
    service.wait_for("STOPPING=1", PATIENCE_S)


def test_a_mistake_in_the_configuration_folder_ends_it_for_good(service: Service) -> None:
    (service.runtime / "etc" / "arbiter.yaml").write_text("gpu:\n  reserv_bytes: 1GiB\n")
    with pytest.raises(RuntimeError, match="ended with 2"):
        service.start()
    assert "arbiter.yaml:2: gpu.reserv_bytes: unknown key" in service.log


# -- a manager stops, restarts and kills it
def status_when(service: Service, good: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    deadline = time.monotonic() + PATIENCE_S
    with WireClient(service.endpoint) as client:
        client.hello("operator", role="operator").ask("subscribe")  # an observer sees no tokens
        while time.monotonic() < deadline:
            status = client.ask("status")
            if good(status):
                return status
            client.receive(0.2)  # any news
    raise AssertionError(f"never as wanted: {status}")


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, signal.SIGABRT, signal.SIGKILL], ids=["stop", "watchdog", "kill"]
)
def test_a_holder_outlives_the_service_with_its_lease(
    service: Service, number: signal.Signals
) -> None:
    service.start()
    holder = spawn(
        "stepper", "holder", str(3 * GIB), str(service.gpu_folder), str(GIB // 2),
        name="holder", environ=service.environ, errors=service.runtime / "errors.log",
    )  # fmt: skip
    granted = holder.until("loading")
    holder.tell("go")
    holder.until("ready")
    holder.tell("use")
    holder.until("in_use")
    service.process.send_signal(number)
    service.process.wait(PATIENCE_S)
    assert holder.alive
    assert (service.runtime / "run").exists()

    service.start()
    status = status_when(service, lambda s: s["phase"] == "serving" and bool(s["leases"]))
    (lease,) = status["leases"]
    assert (lease["lease_id"], lease["token"]) == (granted["lease_id"], granted["token"])
    assert (lease["state"], lease["uses"], lease["pid"]) == ("held", 1, holder.pid)
    holder.tell("go")
    holder.until("idle")
    assert holder.alive, "neither lost nor fenced"
    holder.close()


# -- what the unit forbids
NOBODY = 65534
PR_SET_MDWE, PR_GET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN = 65, 66, 1
NO_EXEC_GAIN = """
import ctypes, os, sys
if ctypes.CDLL(None, use_errno=True).prctl(65, 1, 0, 0, 0):
    sys.exit(f"prctl: {os.strerror(ctypes.get_errno())}")
os.execvp(sys.argv[1], sys.argv[1:])
"""
STRANGER = """
import os, sys
from tests.support.wire import WireClient
os.setgroups([]); os.setresgid(65534, 65534, 65534); os.setresuid(65534, 65534, 65534)
with WireClient(sys.argv[1]) as client:
    lease = client.hello("stranger", role="operator").granted("stranger", 1 << 30)
    print(lease["lease_id"], flush=True)
    sys.stdin.read()
"""


def restricted() -> list[str]:
    """What the unit takes from the daemon and a test can take too: capabilities, new privileges,
    memory that is writable and executable."""
    setpriv = [
        "setpriv",
        "--no-new-privs",
        "--bounding-set=-all",
        "--inh-caps=-all",
        f"--groups={NOBODY}",
        "--",
    ]
    no_exec = [sys.executable, "-c", NO_EXEC_GAIN]
    return [*setpriv, *(no_exec if ctypes.CDLL(None).prctl(PR_GET_MDWE, 0, 0, 0, 0) >= 0 else [])]


@pytest.mark.skipif(
    os.getuid() != 0 or shutil.which("setpriv") is None,
    reason="needs root and setpriv to drop privileges",
)
def test_without_any_capability_it_serves_and_watches_other_users() -> None:
    """A holder of another user connects through the operators' group; its death is seen through
    /proc and a pidfd all the same."""
    service = Service("--gpu fake:8GiB", grp.getgrgid(NOBODY).gr_name)
    service.wrapper = restricted()
    service.runtime.chmod(0o755)
    os.chown(service.runtime / "run", -1, NOBODY)
    (service.runtime / "run").chmod(0o1770)
    try:
        service.start()
        capabilities = [
            line.split()[1] for line in Path(f"/proc/{service.pid}/status").read_text().splitlines()
            if line.startswith(("CapEff", "CapPrm", "CapBnd"))
        ]  # fmt: skip
        assert [int(word, 16) for word in capabilities] == [0, 0, 0]
        with WireClient(service.endpoint) as watcher:
            watcher.hello("watcher", role="observer").ask("subscribe")
            stranger = subprocess.Popen(
                [sys.executable, "-c", textwrap.dedent(STRANGER), service.endpoint],
                env=service.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            lease_id = stranger.stdout.readline().strip()
            (lease,) = watcher.ask("status")["leases"]
            assert (lease["lease_id"], lease["pid"]) == (lease_id, stranger.pid)
            stranger.kill()
            stranger.wait(PATIENCE_S)
            gone = watcher.push(
                "event", where=lambda push: push["event"]["kind"] in ("lost", "cancelled")
            )
            assert gone["event"]["lease_id"] == lease_id
    finally:
        service.close()
