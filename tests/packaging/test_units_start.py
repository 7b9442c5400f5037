"""Every unit under a real systemd with a simulated GPU: it starts, serves, is killed, and comes
back.

The units as `make install-units` copies them once never started: a system call filter ended the
daemon before its first line. Reading the files did not show that.
"""

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.packaging.machine import PATIENCE_S, Machine, obstacle

OBSTACLE = obstacle()
pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(OBSTACLE is not None, reason=f"no systemd can be started here: {OBSTACLE}"),
]
PAGE = Path(__file__).parents[2] / "docs" / "systemd.md"
SYSTEM = "/etc/systemd/system"
ENDPOINT = "ipc:///run/vram-arbiter/arbiter.sock"
ARBITER = "vram-arbiter.service"


def steps(heading: str) -> list[str]:
    """The commands of a section's first block, as root types them."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1]
    block = section.split("```sh\n")[1].split("```")[0].replace("\\\n", "")
    return [line.replace("sudo ", "") for line in block.splitlines()]


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    """Booted and set up by the commands of docs/systemd.md, with a simulated GPU; the units log
    into files."""
    made = Machine()
    try:
        made.run("mkdir", "-m", "1777", "/run/logs")
        for folder, log in ((SYSTEM, "%n"), ("/etc/systemd/user", "%n.%u")):
            output = f"append:/run/logs/{log}.log"
            text = f"[Service]\nStandardOutput={output}\nStandardError={output}\n"
            made.write(f"{folder}/vram-.service.d/log.conf", text)
        # Waiting 15 s for a watchdog shows no more than waiting 5 s does.
        made.write(f"{SYSTEM}/{ARBITER}.d/test.conf", "[Service]\nWatchdogSec=5\n")
        made.write("/etc/vram-arbiter/arbiter.env", 'ARBITER_OPTIONS="--gpu fake:8GiB"\n')
        install = steps("Install")
        assert "-m venv" in install[0]  # these two are done: the environment is mounted
        assert "pip install" in install[1]
        for step in [*install[2:], steps("Permissions")[2]]:
            made.run("bash", "-c", f"cd /opt/tree && {step}")
        yield made
    finally:
        made.close()


def answer_of[T](found: Callable[[], T | None], what: Callable[[], str]) -> T:
    """Ask until there is an answer: what happens inside the machine shows from outside only."""
    deadline = time.monotonic() + PATIENCE_S
    while (answer := found()) is None:
        assert time.monotonic() < deadline, f"not in time:\n{what()}"
        time.sleep(0.05)
    return answer


def leases_inside(
    machine: Machine, endpoint: str = ENDPOINT, user: str | None = None
) -> dict[str, dict[str, Any]] | None:
    """The granted leases by their consumer; None while nothing is granted again after a restart."""
    asked = subprocess.run(
        machine.inside("vramctl", "status", "--json", "--endpoint", endpoint, user=user),
        capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    if asked.returncode:
        return None
    status = json.loads(asked.stdout)
    granted = {
        lease["consumer"]: lease
        for lease in status["leases"]
        if lease["state"] in ("loading", "held")
    }
    return granted if status["phase"] == "serving" else None


@contextmanager
def held_inside(
    machine: Machine, name: str, *options: str, user: str | None = None
) -> Iterator[dict[str, Any]]:
    """A program that runs under a lease."""
    command = ["vramctl", "run", "--endpoint", ENDPOINT, "--name", name, "--vram", "1GiB", *options]
    process = subprocess.Popen(machine.inside(*command, "--", "sleep", "1000", user=user))
    lease = answer_of(
        lambda: (leases_inside(machine) or {}).get(name), lambda: machine.log(ARBITER)
    )
    yield lease
    assert process.poll() is None, "the holder ended with the arbiter"
    machine.run("kill", str(lease["pid"]))
    assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM


def hit(machine: Machine, name: str) -> None:
    """Send the arbiter's main process a signal, and wait until systemd has started it again."""
    before = machine.show(ARBITER, "NRestarts")
    machine.run("systemctl", "kill", "--kill-whom=main", f"--signal={name}", ARBITER)

    def again() -> bool | None:
        restarts, state = machine.show(ARBITER, "NRestarts", "ActiveState")
        return True if [restarts] != before and state == "active" else None

    answer_of(again, lambda: machine.log(ARBITER) + machine.console)


def test_each_group_may_do_its_part(machine: Machine) -> None:
    (text,) = machine.show(ARBITER, "StatusText")
    assert text.startswith("serving Simulated GPU")
    with held_inside(machine, "of-the-group", user="vram-robot"):
        assert "of-the-group" in machine.run("bash", "-lc", "vramctl status", user="vram-robot")
    drain = ("vramctl", "drain", "--reason", "a test", "--endpoint", ENDPOINT)
    machine.run(*drain, user="vram-robot", code=1)

    machine.run("vramctl", "status", "--endpoint", ENDPOINT, user="daemon", code=3)
    for step in steps("Permissions")[:2]:
        machine.run("env", "USER=daemon", "bash", "-c", step)
    machine.run(*drain, user="daemon")
    machine.run("vramctl", "resume", "--endpoint", ENDPOINT, user="daemon")


def test_a_killed_arbiter_comes_back_with_its_leases(machine: Machine) -> None:
    with held_inside(machine, "survivor") as before:
        hit(machine, "KILL")
        after = answer_of(
            lambda: (leases_inside(machine) or {}).get("survivor"), lambda: machine.log(ARBITER)
        )
        assert (after["lease_id"], after["pid"]) == (before["lease_id"], before["pid"])


def test_the_watchdog_ends_an_arbiter_that_hangs(machine: Machine) -> None:
    with held_inside(machine, "patient") as before:
        hit(machine, "STOP")
        assert "Fatal Python error: Aborted" in machine.log(ARBITER), "where it hung, is said"
        after = answer_of(
            lambda: (leases_inside(machine) or {}).get("patient"), lambda: machine.log(ARBITER)
        )
        assert (after["lease_id"], after["pid"]) == (before["lease_id"], before["pid"])


def test_a_mistake_in_the_configuration_is_not_tried_again(machine: Machine) -> None:
    machine.write("/etc/vram-arbiter/arbiter.yaml", "gpu:\n  reserv_bytes: 1GiB\n")
    machine.run("systemctl", "restart", ARBITER, code=1)
    assert machine.show(ARBITER, "ActiveState", "ExecMainStatus") == ["failed", "2"]
    machine.run("rm", "/etc/vram-arbiter/arbiter.yaml")
    machine.start(ARBITER)


def test_the_unit_of_a_user_starts_in_the_manager_of_a_user(machine: Machine) -> None:
    """Such a manager has no privileges: a setting that drops capabilities keeps a unit from
    starting there."""
    home, runtime = "/tmp/home", "/run/user/robot"
    machine.run(
        "install",
        "-d",
        "-o",
        "vram-robot",
        "-m",
        "700",
        home,
        runtime,
        f"{home}/.config/vram-arbiter",
    )
    machine.write(f"{home}/.config/vram-arbiter/arbiter.env", 'ARBITER_OPTIONS="--gpu fake:8GiB"\n')
    machine.write(
        f"{SYSTEM}/manager.service",
        "[Service]\nType=notify\nUser=vram-robot\nDelegate=yes\nKillSignal=SIGKILL\n"
        "ExecStart=/lib/systemd/systemd --user\n"
        f"Environment=HOME={home} XDG_RUNTIME_DIR={runtime} "
        "SYSTEMD_UNIT_PATH=/etc/systemd/user:/run/targets\n",
    )
    machine.run("ln", "-s", "multi-user.target", "/run/targets/default.target")
    machine.run("systemctl", "daemon-reload")
    machine.start("manager.service")
    as_user = ["env", f"XDG_RUNTIME_DIR={runtime}", "systemctl", "--user"]
    machine.run(*as_user, "start", "vram-arbiter", user="vram-robot")
    assert (
        leases_inside(machine, f"ipc://{runtime}/vram-arbiter/arbiter.sock", user="vram-robot")
        == {}
    )
    machine.run("systemctl", "stop", "manager.service")


LOAD = """
import asyncio, sys
from vram_arbiter.clients.sidecar.base import SidecarClient
async def load():
    async with SidecarClient(sys.argv[1], connect_timeout_s=170) as sidecar:
        await sidecar.load()
asyncio.run(load())
"""


@pytest.mark.heavy
def test_sidecar_runner_and_reasoner_start_beside_it(machine: Machine) -> None:
    """A model loads under a lease, a robot is stopped, and a task fails because of that, each as
    its unit's user."""
    machine.run(
        "chmod", "-R", "g+rwX", "/run/vram-arbiter/fakegpu"
    )  # a driver serves several users
    skill = "vram_arbiter/configs/rskills/so101-progress/rskill.yaml"
    manifest = f"/opt/vram-arbiter/lib/python3*/site-packages/{skill}"
    options = f"--rskill {manifest} --device fake:/run/vram-arbiter/fakegpu"
    options = machine.run("sh", "-c", f"echo {options}").strip()
    machine.write("/etc/vram-arbiter/sidecar-reward.env", f'SIDECAR_OPTIONS="{options}"\n')
    machine.write("/etc/vram-arbiter/reasoner-tidy.env", 'TASK="grab the red cube"\n')
    sidecar, runner, reasoner = "vram-sidecar@reward", "vram-runner@sim", "vram-reasoner@tidy"

    machine.start(sidecar)
    machine.start(runner)
    load = ("/opt/vram-arbiter/bin/python", "-c", LOAD, "ipc:///run/vram-arbiter/reward.sock")
    try:
        machine.run(*load, user="vram-robot")
    except AssertionError as error:
        raise AssertionError(machine.log(f"{sidecar}.service")) from error
    assert set(leases_inside(machine) or {}) == {"reward"}

    answer_of(
        lambda: True if "runner.sock" in machine.run("ls", "/run/vram-arbiter").split() else None,
        lambda: machine.log(f"{runner}.service"),
    )
    machine.run("vram-runner", "estop", "--reason", "a test", user="vram-robot")
    machine.start(reasoner)
    answer_of(
        lambda: True if machine.show(reasoner, "ActiveState") == ["failed"] else None,
        lambda: machine.log(f"{reasoner}.service"),
    )
    assert "emergency stop: a test" in machine.log(f"{reasoner}.service")
    assert machine.show(reasoner, "ExecMainStatus") == ["1"]
    machine.run("systemctl", "stop", sidecar, runner)
    assert machine.show(sidecar, "Result") == ["success"]
    assert machine.show(runner, "Result") == ["success"]
