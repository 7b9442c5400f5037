"""Every unit under a real systemd with a simulated GPU: it starts, serves, is killed, and comes
back.

Installed, upgraded and removed by `vramctl` as docs/how-to/systemd.md says. The units once never
started: a system call filter ended the daemon before its first line. Reading the files did not show
that. The arbiter's unit is tried in every run of the tests, the others at night.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.packaging.machine import PATH, PATIENCE_S, Machine, obstacle
from tests.packaging.wheels import wheels_into
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE

OBSTACLE = obstacle()
pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(OBSTACLE is not None, reason=f"no systemd can be started here: {OBSTACLE}"),
]
HOW_TO = Path(__file__).parents[2] / "docs/how-to"
SYSTEM = "/etc/systemd/system"
ENDPOINT = "ipc:///run/vram-arbiter/arbiter.sock"
ARBITER = "vram-arbiter.service"
LOADER = "/etc/ld.so.conf.d/opt-python.conf"


def steps(heading: str, page: str = "systemd.md") -> list[str]:
    """The commands of a section's first block, as root types them."""
    section = (HOW_TO / page).read_text(encoding="utf-8").split(f"\n## {heading}\n")[1]
    block = re.sub(r"\\\n *", "", section.split("```sh\n")[1].split("```")[0])
    return [line.replace("sudo ", "") for line in block.splitlines()]


@pytest.fixture(scope="module")
def booted() -> Iterator[Machine]:
    """A machine whose units will log into files, with a simulated GPU."""
    made = Machine()
    try:
        made.run("mkdir", "-m", "1777", "/run/logs")
        output = "append:/run/logs/%n.log"
        text = f"[Service]\nStandardOutput={output}\nStandardError={output}\n"
        made.write(f"{SYSTEM}/vram-.service.d/log.conf", text)
        # Waiting 15 s for a watchdog shows no more than waiting 5 s does.
        made.write(f"{SYSTEM}/{ARBITER}.d/test.conf", "[Service]\nWatchdogSec=5\n")
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def before(booted: Machine) -> set[str]:
    """What was on the machine before the installation."""
    return files_inside(booted)


@pytest.fixture(scope="module")
def machine(booted: Machine, before: set[str]) -> Machine:
    """Set up by the commands of docs/how-to/systemd.md: first without a GPU, where everything but
    the start succeeds, then again with a simulated one."""
    whole, join = steps("Install")
    venv, pip, install = whole.split(" && ")
    assert "-m venv" in venv  # these two are done: the environment is mounted
    assert "pip install" in pip
    command = ["bash", "-c", f"{install.partition('#')[0]} --yes 2>&1"]
    booted.run("mv", LOADER, f"{LOADER}.off")  # the interpreter's own is hidden from units
    booted.run("ldconfig")
    said = booted.run(*command, code=1)
    assert "unshare failed" in said
    assert "libpython" in said
    booted.run("mv", f"{LOADER}.off", LOADER)
    booted.run("ldconfig")
    said = booted.run(*command, code=1)
    assert "why the arbiter does not start" in said

    booted.write("/etc/vram-arbiter/arbiter.env", 'ARBITER_OPTIONS="--gpu fake:8GiB"\n')
    said = booted.run(*command)
    assert {line.split()[0] for line in said.splitlines()[1:]} == {"check", "same", "run"}
    booted.run("env", "USER=daemon", "bash", "-c", join)
    return booted


def files_inside(machine: Machine) -> set[str]:
    """Return a line for each file, link and folder that an installation could touch, but for the
    lock and the backups that the tools for users keep."""
    settings = "etc usr/local/bin usr/local/share"
    places = f"{settings} var/lib var/cache run/vram-arbiter"
    found = machine.run(
        "bash", "-c",
        f"cd /; find {places} \\( -path var/lib/dpkg -o -path var/lib/apt \\) -prune -o "
        f"-printf '%p %y %l %m %U\\n' 2>/dev/null; find {settings} -type f | xargs sha256sum",
    )  # fmt: skip
    kept = re.compile(r"\betc/(?:(?:passwd|group|shadow|gshadow|subuid|subgid)-|\.pwd\.lock)")
    return {line for line in found.splitlines() if not kept.search(line)}


ASKING = """
import json, sys
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.wire.requests import Status
for endpoint in sys.stdin:
    try:
        reply = ask(Status(), endpoint.strip(), role="operator")
    except VramError:
        reply = None
    print(json.dumps(reply if reply and reply["ok"] else None), flush=True)
"""
"""Program that prints an operator's status of each endpoint that it reads, null without one: an
interpreter for each look takes 0.3 s of a core."""


def first_answer[T](found: Callable[[], T | None], what: Callable[[], str]) -> T:
    """Ask until there is an answer: what happens inside the machine shows from outside only."""
    deadline = time.monotonic() + PATIENCE_S
    while (answer := found()) is None:
        assert time.monotonic() < deadline, f"not in time:\n{what()}"
        time.sleep(0.2)  # each look starts programs inside
    return answer


def leases_inside(machine: Machine) -> dict[str, dict[str, Any]] | None:
    """The granted leases by their consumer; None while nothing is granted again after a restart."""
    status = machine.answer(ASKING, ENDPOINT)
    if status is None or status["phase"] != "serving":
        return None
    leases = [lease for lease in status["leases"] if lease["state"] in ("loading", "held")]
    return {lease["consumer"]: lease for lease in leases}


@contextmanager
def held_inside(
    machine: Machine, name: str, *options: str, user: str | None = None
) -> Iterator[dict[str, Any]]:
    """A program that runs under a lease."""
    command = ["vramctl", "run", "--endpoint", ENDPOINT, "--name", name, "--vram", "1GiB", *options]
    process = subprocess.Popen(machine.inside(*command, "--", "sleep", "1000", user=user))
    lease = first_answer(
        lambda: (leases_inside(machine) or {}).get(name), lambda: machine.log(ARBITER)
    )
    try:
        yield lease
        assert process.poll() is None, "the holder ended with the arbiter"
    finally:
        if process.poll() is None:
            machine.run("kill", str(lease["pid"]))
            assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM


def hit(machine: Machine, name: str) -> None:
    """Send the arbiter's main process a signal, and wait until systemd has started it again."""
    before = machine.show(ARBITER, "NRestarts")
    machine.run("systemctl", "kill", "--kill-whom=main", f"--signal={name}", ARBITER)

    def again() -> bool | None:
        restarts, state = machine.show(ARBITER, "NRestarts", "ActiveState")
        return True if [restarts] != before and state == "active" else None

    first_answer(again, lambda: machine.log(ARBITER) + machine.console)


def test_each_group_may_do_its_part(machine: Machine) -> None:
    """`daemon` and `games` are two users of Debian without a group of ours."""
    (text,) = machine.show(ARBITER, "StatusText")
    assert text.startswith("serving Simulated GPU")
    with held_inside(machine, "of-the-group", user="vram-robot"):
        assert "of-the-group" in machine.run("bash", "-lc", "vramctl status", user="vram-robot")
    drain = ("vramctl", "drain", "--reason", "a test", "--endpoint", ENDPOINT)
    machine.run(*drain, user="vram-robot", code=1)

    machine.run("vramctl", "status", "--endpoint", ENDPOINT, user="games", code=3)
    for step in steps("Permissions")[:2]:
        machine.run("env", "USER=games", "bash", "-c", step)
    for operator in ("daemon", "games"):
        machine.run(*drain, user=operator)
        machine.run("vramctl", "resume", "--endpoint", ENDPOINT, user=operator)
    for step in steps("Permissions")[:2]:
        group = step.split("--groups ")[1].split()[0]
        machine.run("gpasswd", "--delete", "games", group)


def test_a_killed_arbiter_comes_back_with_its_leases(machine: Machine) -> None:
    with held_inside(machine, "survivor") as before:
        hit(machine, "KILL")
        after = first_answer(
            lambda: (leases_inside(machine) or {}).get("survivor"), lambda: machine.log(ARBITER)
        )
        assert (after["lease_id"], after["pid"]) == (before["lease_id"], before["pid"])


HOOKS = """
hooks:
  - name: seen
    on: [granted]
    command: [/bin/sh, -c, "cd $STATE_DIRECTORY; cat >>seen; vramctl drain -r no 2>>no"]
"""


@pytest.mark.nightly
def test_hooks_run_as_their_page_says(machine: Machine) -> None:
    """They hear of what happened while they were stopped, and may look, not act."""
    copied, started, _ = (step.partition("#")[0] for step in steps("Service", "hooks.md"))
    machine.run("sh", "-c", copied)
    machine.write("/etc/vram-arbiter/observer.yaml", HOOKS)

    def seen() -> set[str]:
        lines = machine.run("sh", "-c", "cat /var/lib/vram-observer/seen 2>/dev/null; true")
        return {json.loads(line)["consumer"] for line in lines.splitlines()}

    def granted_to(name: str) -> None:
        first_answer(
            lambda: True if name in seen() else None, lambda: machine.log("vram-observer.service")
        )

    machine.run("sh", "-c", started)
    with held_inside(machine, "led"):
        granted_to("led")
    machine.run("systemctl", "stop", "vram-observer")
    with held_inside(machine, "meanwhile"):
        machine.run("systemctl", "start", "vram-observer")
        granted_to("meanwhile")

    def refused() -> bool | None:
        """Its command says why only after it has noted the event."""
        said = machine.read("/var/lib/vram-observer/no")
        return "operators' group may be operator" in said or None

    first_answer(refused, lambda: machine.log("vram-observer.service"))
    machine.run("systemctl", "disable", "--now", "vram-observer")


def test_the_watchdog_ends_an_arbiter_that_hangs(machine: Machine) -> None:
    with held_inside(machine, "patient") as before:
        hit(machine, "STOP")
        assert "Fatal Python error: Aborted" in machine.log(ARBITER), "where it hung, is said"
        after = first_answer(
            lambda: (leases_inside(machine) or {}).get("patient"), lambda: machine.log(ARBITER)
        )
        assert (after["lease_id"], after["pid"]) == (before["lease_id"], before["pid"])


def test_a_mistake_in_the_configuration_is_not_tried_again(machine: Machine) -> None:
    machine.write("/etc/vram-arbiter/arbiter.yaml", "gpu:\n  reserv_bytes: 1GiB\n")
    machine.run("systemctl", "reload", ARBITER)
    first_answer(
        lambda: "config_refused" in machine.log(ARBITER) or None, lambda: machine.log(ARBITER)
    )
    status = machine.run("vramctl", "status", "--endpoint", ENDPOINT)
    assert "arbiter.yaml:2: see `vram-arbiter" in status, "refused, and the arbiter goes on"
    machine.run("systemctl", "restart", ARBITER, code=1)
    assert machine.show(ARBITER, "ActiveState", "ExecMainStatus") == ["failed", "2"]
    machine.run("rm", "/etc/vram-arbiter/arbiter.yaml")
    machine.start(ARBITER)


HOME, RUNTIME = "/tmp/home", "/run/user/robot"


@contextmanager
def manager_of_a_user(machine: Machine) -> Iterator[Callable[..., str]]:
    """Start `systemd --user` of vram-robot, with the units installed for that user. Yields what
    `Machine.run` does as the user."""
    own = ["install", "-d", "-o", "vram-robot", "-m", "700"]
    machine.run(*own, HOME, RUNTIME, f"{HOME}/.config", f"{HOME}/.config/vram-arbiter")
    machine.write(f"{HOME}/.config/vram-arbiter/arbiter.env", 'ARBITER_OPTIONS="--gpu fake:8GiB"\n')
    machine.write(
        f"{SYSTEM}/manager.service",
        "[Service]\nType=notify\nUser=vram-robot\nDelegate=yes\nKillSignal=SIGKILL\n"
        "ExecStart=/lib/systemd/systemd --user\n"
        "StandardError=append:/run/logs/manager.log\n"
        f"Environment=HOME={HOME} XDG_RUNTIME_DIR={RUNTIME} "
        f"SYSTEMD_UNIT_PATH={HOME}/.config/systemd/user:/run/targets\n",
    )
    machine.run("ln", "-sf", "multi-user.target", "/run/targets/default.target")
    machine.run("systemctl", "daemon-reload")
    machine.start("manager.service")

    def as_user(*command: str, code: int = 0) -> str:
        environ = ("env", f"HOME={HOME}", f"XDG_RUNTIME_DIR={RUNTIME}")
        return machine.run(*environ, *command, user="vram-robot", code=code)

    as_user("vramctl", "install", "--user-units", "--yes")
    yield as_user
    as_user("vramctl", "uninstall", "--user-units", "--purge", "--yes")
    left = machine.run("find", HOME, RUNTIME, "!", "-type", "d").split()
    assert not [path for path in left if "vram" in path]
    machine.run("systemctl", "stop", "manager.service")
    machine.run("rm", f"{SYSTEM}/manager.service")


@pytest.mark.nightly
def test_the_unit_of_a_user_starts_in_the_manager_of_a_user(machine: Machine) -> None:
    """Such a manager has no privileges: a setting that drops capabilities keeps a unit from
    starting there."""
    with manager_of_a_user(machine) as as_user:
        as_user("vramctl", "install", "--yes", code=2)  # the machine's: for root
        endpoint = f"ipc://{RUNTIME}/vram-arbiter/arbiter.sock"
        status = as_user("vramctl", "status", "--json", "--endpoint", endpoint)
        assert json.loads(status)["phase"] == "serving"


ROBOT = "vram-arm1"
TUNNEL = f"vram-remote@{ROBOT}@127.0.0.1"
KEY = f"{HOME}/.config/vram-arbiter/arm1"


@contextmanager
def server_of_robots(machine: Machine) -> Iterator[None]:
    """Start sshd as this machine configures it, with the drop-in of the installation."""
    machine.run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", "/run/host_key")
    machine.write(
        f"{SYSTEM}/robots.service",
        "[Service]\nRuntimeDirectory=sshd\nExecStart=/usr/sbin/sshd -D -e -h /run/host_key\n"
        "StandardError=append:/run/logs/robots.log\n",
    )
    machine.run("systemctl", "daemon-reload")
    machine.start("robots.service")
    yield
    machine.run("systemctl", "stop", "robots.service")
    machine.run("rm", f"{SYSTEM}/robots.service")
    machine.run("userdel", ROBOT)
    machine.run("rm", "-r", "/etc/ssh/vram-guests")


@pytest.mark.nightly
@pytest.mark.skipif(not os.access("/usr/sbin/sshd", os.X_OK), reason="needs openssh-server")
def test_the_unit_of_a_tunnel_keeps_it_and_gives_a_refused_one_up(machine: Machine) -> None:
    """A robot beside its server: the key is let in, the session and the keeper are killed, and the
    key is taken away."""
    with manager_of_a_user(machine) as as_user, server_of_robots(machine):
        settings = f"{HOME}/.config"
        machine.write(
            f"{settings}/systemd/user/vram-remote@.service.d/test.conf",
            "[Service]\nRestartSec=100ms\nStandardError=append:/run/logs/tunnel.log\n",
        )
        options = f"{settings}/vram-arbiter/remote-{ROBOT}@127.0.0.1.env"
        machine.write(options, f'REMOTE_OPTIONS="--identity {KEY}"\n')
        host_key = machine.read("/run/host_key.pub")
        machine.write(f"{settings}/vram-arbiter/known_hosts", f"127.0.0.1 {host_key}")
        as_user("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", KEY)
        authorize = ("vramctl", "remote", "authorize", f"{KEY}.pub", "--name", "arm1", "--install")
        machine.run(*authorize)
        as_user("systemctl", "--user", "daemon-reload")

        def log() -> str:
            return "\n".join(machine.read(f"/run/logs/{name}.log") for name in ("tunnel", "robots"))

        def shown(*properties: str) -> list[str]:
            told = as_user(
                "systemctl", "--user", "show", TUNNEL, "--property", ",".join(properties)
            )
            found = dict(line.split("=", 1) for line in told.splitlines())
            return [found[name] for name in properties]

        def sessions() -> set[str]:
            return {*machine.run("sh", "-c", f"pgrep -u {ROBOT}; true").split()}

        def kill(*processes: str) -> None:
            """Kill processes, and wait for a tunnel through another session."""
            before = sessions()
            machine.run("kill", "-KILL", *processes)

            def again() -> bool | None:
                now, (said,) = sessions(), shown("StatusText")
                return True if now and not now & before and "is up" in said else None

            first_answer(again, log)

        as_user("systemctl", "--user", "start", TUNNEL)
        (tunnel,) = json.loads(as_user("vramctl", "remote", "status", "--json"))["tunnels"]
        assert (tunnel["state"], tunnel["role"]) == ("up", "guest")
        (keeper,) = shown("MainPID")
        kill(*sessions())
        assert shown("MainPID", "NRestarts") == [keeper, "0"], "the keeper connects again itself"
        kill(keeper)
        assert shown("NRestarts") == ["1"]

        machine.run("rm", f"/etc/ssh/vram-guests/{ROBOT}")
        machine.run("kill", "-KILL", *sessions())
        first_answer(lambda: True if shown("ActiveState") == ["failed"] else None, log)
        assert shown("ExecMainStatus", "NRestarts") == ["1", "10"], "the eleventh start is none"
        assert log().count("refuses the tunnel") == 9
        assert "on the server: `vramctl remote authorize`" in log()

        machine.run(*authorize)
        as_user("systemctl", "--user", "reset-failed", TUNNEL)
        as_user("systemctl", "--user", "start", TUNNEL)
        as_user("systemctl", "--user", "stop", TUNNEL)
        assert shown("ActiveState", "Result", "ExecMainStatus") == ["inactive", "success", "0"]
        machine.run("rm", "-r", f"{settings}/systemd/user/vram-remote@.service.d")


SERVED, GATEWAY = "llm.service", "vram-gateway.service"
ASK = r"""exec 3<>/dev/tcp/127.0.0.1/$1
printf 'GET /upstream/llm/v1/models HTTP/1.1\r\nx-api-key: %s\r\n' $2 >&3
printf 'Host: 127.0.0.1:%s\r\nConnection: close\r\n\r\n' $1 >&3
cat <&3"""


@pytest.mark.nightly
def test_setup_puts_a_unit_under_a_lease_which_stops_and_starts_it(machine: Machine) -> None:
    """A model server that runs is found, adopted with its bytes, stopped by an eviction, and
    started by a request. Its processes are no descendants of the lease's holder."""
    folder = "/run/vram-arbiter/fakegpu"
    machine.run("chmod", "-R", "g+rwX", folder)  # a driver serves several users
    stand_in = "/opt/vram-arbiter/bin/python -m vram_arbiter.sidecars.gateway.stand_in llm 3GiB"
    machine.write("/usr/local/bin/llama-server", f"#!/bin/sh\nexec {stand_in} $2\n")
    machine.run("chmod", "755", "/usr/local/bin/llama-server")
    machine.write(
        f"{SYSTEM}/{SERVED}",
        "[Service]\nUser=vram-robot\nGroup=vram-arbiter\nUMask=0007\n"
        f"Environment={FOLDER_VARIABLE}={folder}\n"
        "ExecStart=/usr/local/bin/llama-server --port 8123\n"
        f"StandardError=append:/run/logs/{SERVED}.log\n",
    )
    machine.run("systemctl", "daemon-reload")
    machine.start(SERVED)

    def read() -> tuple[list[Any], dict[str, Any]]:
        """All leases, and the process that holds bytes."""
        status = machine.answer(ASKING, ENDPOINT)
        used = [one for one in status["gpus"][0]["processes"] if one["used_bytes"]]
        return status["leases"], used[0] if used else {}

    def log() -> str:
        return machine.log(SERVED) + machine.log(GATEWAY)

    first_answer(lambda: read()[1] or None, log)
    setup = ("/opt/vram-arbiter/bin/vram-gateway", "setup", "--endpoint", ENDPOINT)
    said = machine.run(*setup).splitlines()
    port, key = said[1].rpartition(":")[2], said[3].partition("=")[2]

    leases, process = first_answer(
        lambda: found if (found := read())[1].get("lease_ids") else None, log
    )
    assert leases[0]["consumer"] == "llm"
    assert (process["used_bytes"], process["stowaway"]) == (3 << 30, False)
    assert process["lease_ids"] == [leases[0]["lease_id"]]
    machine.run("vramctl", "evict", "llm", "-r", "a test", "--endpoint", ENDPOINT)
    first_answer(lambda: True if read() == ([], {}) else None, log)
    assert machine.show(SERVED, "ActiveState") == ["inactive"]
    assert '"id": "llm"' in machine.run("bash", "-c", ASK, "bash", port, key), log()
    assert [one["consumer"] for one in read()[0]] == ["llm"]

    machine.run("systemctl", "disable", "--now", GATEWAY)
    assert machine.show(SERVED, "ActiveState") == ["inactive"], "it ends with the gateway"
    settings = "/etc/vram-arbiter"
    for path in (f"{SYSTEM}/{SERVED}", "/usr/local/bin/llama-server"):
        machine.run("rm", path)
    machine.run("sh", "-c", f"rm {settings}/gateway*")
    machine.run("systemctl", "daemon-reload")


LOAD = """
import asyncio, sys
from vram_arbiter.clients.sidecar.base import SidecarClient
async def load():
    async with SidecarClient(sys.argv[1], connect_timeout_s=170) as sidecar:
        await sidecar.load()
asyncio.run(load())
"""


@pytest.mark.heavy
@pytest.mark.nightly  # three programs import torch once more
def test_sidecar_runner_and_reasoner_start_beside_it(machine: Machine) -> None:
    """A model loads under a lease, a robot is stopped, and a task fails because of that, each as
    its unit's user."""
    # a driver serves several users
    machine.run("chmod", "-R", "g+rwX", "/run/vram-arbiter/fakegpu")
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

    first_answer(
        lambda: True if "runner.sock" in machine.run("ls", "/run/vram-arbiter").split() else None,
        lambda: machine.log(f"{runner}.service"),
    )
    guest = ("setpriv", "--reuid=games", "--regid=vram-guests", "--groups=vram-arbiter")
    machine.run(*guest, *load)
    state = ("vram-runner", "state", "--endpoint", "ipc:///run/vram-arbiter/runner.sock")
    said = machine.run("sh", "-c", '! "$@" 2>&1', "sh", *guest, *state)
    assert "a guest may not use runner" in said
    machine.run("vram-runner", "estop", "--reason", "a test", user="vram-robot")
    machine.start(reasoner)
    first_answer(
        lambda: True if machine.show(reasoner, "ActiveState") == ["failed"] else None,
        lambda: machine.log(f"{reasoner}.service"),
    )
    assert "emergency stop: a test" in machine.log(f"{reasoner}.service")
    assert machine.show(reasoner, "ExecMainStatus") == ["1"]
    machine.run("systemctl", "stop", sidecar, runner)
    assert machine.show(sidecar, "Result") == ["success"]
    assert machine.show(runner, "Result") == ["success"]


@pytest.mark.nightly
def test_one_line_installs_the_wheel_and_starts_the_arbiter() -> None:
    """The line of the page, on a machine with Python, systemd and a folder of wheels for an
    index."""
    with (
        tempfile.TemporaryDirectory(dir="/var/tmp") as folder,  # /tmp is hidden inside
        closing(Machine()) as made,
    ):
        wheels_into(Path(folder))
        made.run("umount", "/opt/vram-arbiter")  # the line makes it anew
        made.write("/etc/vram-arbiter/arbiter.env", 'ARBITER_OPTIONS="--gpu fake:8GiB"\n')
        line, _ = steps("Install")
        where = (f"PATH=/opt/python/bin:{PATH}", f"PIP_FIND_LINKS={folder}", "PIP_NO_INDEX=1")
        typed = ("env", "--chdir", folder, *where, "bash", "-c", line.partition("#")[0])
        assert "Proceed? [y/N]" in made.run(*typed, stdin="y\n")
        assert made.show(ARBITER, "ActiveState") == ["active"]
        assert "Simulated GPU" in made.run("vramctl", "status", "--endpoint", ENDPOINT)


def put_next_version(machine: Machine) -> None:
    """Replace the package under the running programs, as pip does; the next version's units
    differ."""
    (package,) = machine.prefix.glob("lib/python3*/site-packages/vram_arbiter")
    fresh = package.with_name("fresh")
    shutil.copytree(package, fresh)
    for unit in (fresh / "configs/systemd/system").glob("*.service"):
        unit.write_text(unit.read_text() + "# of the next version\n")
    shutil.rmtree(package)
    fresh.rename(package)


def tokens_inside(machine: Machine) -> dict[str, list[int] | None]:
    """The tokens of all leases, which an operator sees."""
    return {name: lease["token"] for name, lease in (leases_inside(machine) or {}).items()}


@pytest.mark.nightly
def test_an_upgrade_keeps_leases_and_files_of_the_operator(machine: Machine) -> None:
    edited = f"{SYSTEM}/vram-sidecar@.service"
    machine.write(edited, machine.read(edited) + "# of the operator\n")
    with held_inside(machine, "first") as first, held_inside(machine, "second") as second:
        put_next_version(machine)
        said = machine.run("vramctl", "install", "--yes")
        assert f"replace {SYSTEM}/{ARBITER}" in said
        assert f"{edited}: changed by hand" in said
        assert machine.read(edited).endswith("# of the operator\n")
        assert "systemctl try-restart vram-arbiter.service" in said

        tokens = tokens_inside(machine)
        machine.run("systemctl", "restart", ARBITER)
        for held in (first, second):
            name = held["consumer"]
            after = first_answer(
                lambda name=name: (leases_inside(machine) or {}).get(name),
                lambda: machine.log(ARBITER),
            )
            assert (after["lease_id"], after["pid"]) == (held["lease_id"], held["pid"])
        assert tokens_inside(machine) == tokens
        assert len(tokens) == 2
        assert None not in tokens.values()


def test_a_removal_leaves_nothing_behind(machine: Machine, before: set[str]) -> None:
    edited = f"{SYSTEM}/vram-sidecar@.service"
    machine.write(edited, machine.read(edited) + "# of the operator\n")
    said = machine.run("vramctl", "uninstall", "--yes")
    assert f"{SYSTEM}/vram-sidecar@.service: changed by hand" in said
    kept = {line.split()[0].strip("/") for line in files_inside(machine) - before}
    assert "etc/systemd/system/vram-sidecar@.service" in kept
    assert "etc/vram-arbiter/arbiter.env" in kept
    assert "var/lib/vram-arbiter" in kept
    assert not [path for path in kept if "usr/local" in path or path.endswith(ARBITER)]

    machine.run("rm", f"{SYSTEM}/vram-sidecar@.service")
    purge = ("/opt/vram-arbiter/bin/vramctl", "uninstall", "--purge")
    machine.run(*purge, "--yes")
    expected = re.compile(r" etc/(?:passwd|group|g?shadow)$| d +755 0$")  # and empty folders
    assert [line for line in files_inside(machine) ^ before if not expected.search(line)] == []
