"""`vramctl run` as a program: what it starts, passes on and measures, and what ends its program."""

import asyncio
import fcntl
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from tests.support.leases import Spec, view_of
from tests.support.process import ArbiterProcess, vramctl
from tests.support.running import Running, running
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients import cuda
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.foreign.program import Program
from vram_arbiter.clients.foreign.run_spec import RunSpec
from vram_arbiter.clients.foreign.supervisor import Supervisor
from vram_arbiter.clients.sync import Client

PROGRAM = """
import signal, sys
ints = []
signal.signal(signal.SIGTERM, lambda *_: sys.exit(5 + len(ints)))
signal.signal(signal.SIGQUIT, lambda *_: sys.exit(9))
signal.signal(signal.SIGINT, lambda *_: (ints.append(1), print("int", flush=True)))
print("up", flush=True)
while True:
    signal.pause()
"""
"""Ends with 5 on SIGTERM and with 1 more for each SIGINT before."""
DEAF = (
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); "
    "time.sleep(1000)"
)


RUN = ("run", "--vram", "5GiB", "--name")


def job(
    environ: Mapping[str, str], *options: str, name: str = "job", program: str = PROGRAM
) -> AbstractContextManager[Running]:
    """A program under `vramctl run`."""
    words = (*RUN, name, *options, "--", sys.executable, "-c", program)
    return running("vramctl", words, environ)


@contextmanager
def up(environ: Mapping[str, str], *options: str, program: str = PROGRAM) -> Iterator[Running]:
    """One that prints when it is up, and is."""
    with job(environ, *options, program=program) as run:
        assert run.line() == "up"
        yield run


# -- the program
@pytest.mark.e2e
def test_run_leases_for_a_program(arbiter_daemon: ArbiterProcess) -> None:
    environ = {**arbiter_daemon.environ, "CUDA_VISIBLE_DEVICES": "3"}
    script = "import os, sys; print(*(os.environ[name] for name in sys.argv[1:])); sys.exit(7)"
    names = ("VRAM_LEASE_ID", "VRAM_LEASE_TOKEN", "CUDA_VISIBLE_DEVICES")
    run = ("run", "--vram", "1GiB", "--name", "job", "--", sys.executable, "-c", script, *names)
    done = vramctl(*run, environ=environ)
    assert done.returncode == 7
    assert re.fullmatch(r"L(\d+)-1 \1\.\d+ 3\n", done.stdout)
    assert "peak not measured" in done.stderr
    history = json.loads(vramctl("history", "--json", environ=environ).stdout)["events"]
    story = [
        (event["kind"], event.get("exiting")) for event in history if event.get("consumer") == "job"
    ]
    assert ("granted", None) in story
    assert ("released", True) in story


@pytest.mark.parametrize(
    ("gpu", "environ", "variables"),
    [
        ("GPU-1", {}, {"CUDA_VISIBLE_DEVICES": "GPU-1", "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}),
        ("MIG-1", {"CUDA_DEVICE_ORDER": "FASTEST_FIRST"}, {"CUDA_VISIBLE_DEVICES": "MIG-1"}),
        ("GPU-1", {"CUDA_VISIBLE_DEVICES": "0"}, {}),
        ("GPU-fake-1", {}, {}),
        ("UNIFIED-0", {}, {}),
        ("AMD-c0ffee", {}, {"ROCR_VISIBLE_DEVICES": "GPU-c0ffee"}),
        ("AMD-c0ffee", {"HIP_VISIBLE_DEVICES": "0"}, {}),
        ("PCI-0000:03:00.0", {}, {}),
    ],
)
def test_cuda_sees_the_granted_gpu(
    gpu: str, environ: dict[str, str], variables: dict[str, str]
) -> None:
    """A program on a machine with two GPUs took the first, whichever was granted."""
    assert cuda.visible(gpu, environ) == variables


@pytest.mark.parametrize(
    ("named", "found"),
    [("MIG-1", "MIG-1"), ("MIG-1,MIG-2", None), ("GPU-1", None), ("0", None), (None, None)],
)
def test_a_program_knows_the_instance_that_it_was_granted(
    named: str | None, found: str | None
) -> None:
    assert cuda.instance({} if named is None else {"CUDA_VISIBLE_DEVICES": named}) == found


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        (["/nonexistent/program"], 127, "not found"),
        ([""], 127, "not found"),
        (["/"], 127, "not a file that may be executed"),
        ([__file__], 127, "not a file that may be executed"),
        (["--pin", "--on-revoke", "term", "true"], 2, "cannot be combined"),
        (["--gpu", "", "true"], 2, "--gpu: "),
        (["--name", "x\n", "true"], 2, "--name: "),
    ],
)
def test_codes_of_what_is_never_started(
    command: list[str], code: int, said: str, tmp_path: Path
) -> None:
    """Known before any arbiter is asked."""
    environ = {**os.environ, "VRAM_ARBITER_RUNTIME": str(tmp_path)}
    done = vramctl("run", "--vram", "1GiB", *command, environ=environ)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.e2e
def test_codes_of_run(arbiter_daemon: ArbiterProcess, tmp_path: Path) -> None:
    environ = arbiter_daemon.environ
    done = vramctl("run", "--vram", "9GiB", "true", environ=environ)
    assert (done.returncode, "needs 9" in done.stderr) == (1, True)
    done = vramctl("run", "--vram", "1GiB", "sh", "-c", "kill -TERM $$", environ=environ)
    assert done.returncode == 128 + signal.SIGTERM
    unknown = tmp_path / "format"
    unknown.write_text("no program")
    unknown.chmod(0o755)
    done = vramctl("run", "--vram", "1GiB", str(unknown), environ=environ)
    assert (done.returncode, "Exec format error" in done.stderr) == (126, True)


@pytest.mark.e2e
def test_a_program_may_have_any_name(arbiter_daemon: ArbiterProcess, tmp_path: Path) -> None:
    """Undecodable bytes, control characters and long names ended in a traceback."""
    for name in (b"\xff\xfe", b"\x1b[31m\n", b"x" * 200):
        program = os.fsencode(tmp_path) + b"/" + name
        with open(program, "wb") as file:
            file.write(b"#!/bin/sh\nexit 3\n")
        os.chmod(program, 0o755)
        done = vramctl("run", "--vram", "1GiB", program, environ=arbiter_daemon.environ)
        assert done.returncode == 3, done.stderr
        assert "\x1b" not in done.stderr


# -- signals
@pytest.mark.e2e
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 5), (signal.SIGQUIT, 9)])
def test_run_passes_signals_on(
    number: signal.Signals, code: int, arbiter_daemon: ArbiterProcess
) -> None:
    with up(arbiter_daemon.environ) as run:
        assert run.ended(number) == code


@pytest.mark.e2e
def test_an_interrupt_by_another_process_is_passed_on(arbiter_daemon: ArbiterProcess) -> None:
    """`kill -INT` of `vramctl` reached nothing: its program was left to run."""
    with up(arbiter_daemon.environ) as run:
        run.process.send_signal(signal.SIGINT)
        assert run.line() == "int"
        assert run.ended(signal.SIGTERM) == 6


@pytest.mark.e2e
def test_the_terminals_interrupt_reaches_the_program_once(arbiter_daemon: ArbiterProcess) -> None:
    """The terminal sends it to both. Passed on as well, a program would take it for the second
    Ctrl-C, which ends many at once."""
    master, slave = pty.openpty()
    attributes = termios.tcgetattr(slave)
    attributes[3] &= ~termios.ECHO
    termios.tcsetattr(slave, termios.TCSANOW, attributes)
    words = (*RUN, "job", "--", sys.executable, "-c", PROGRAM)
    process = subprocess.Popen(
        [sys.executable, "-m", "vram_arbiter.clients", *words],
        env=arbiter_daemon.environ, stdin=slave, stdout=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "up\n"
        os.write(master, b"\x03")
        assert process.stdout.readline() == "int\n"
        process.terminate()
        assert process.wait(PATIENCE_S) == 6
    finally:
        process.kill()
        process.communicate()
        os.close(master)
        os.close(slave)


# -- room for others
@pytest.mark.e2e
@pytest.mark.parametrize("options", [(), ("--pin",)], ids=["default", "pinned"])
def test_two_programs_that_do_not_fit_together_run_one_after_the_other(
    options: tuple[str, ...], client: Client, arbiter_daemon: ArbiterProcess
) -> None:
    """The second was denied at once, because the first was pinned."""
    environ = arbiter_daemon.environ
    last = "raise SystemExit(4)"
    with (
        up(environ, *options) as first,
        job(environ, "--wait", "60", name="next", program=last) as second,
    ):
        second.said("waiting: ")
        if not options:
            first.said("next waits for its room (priority 40)")
        assert (view_of(client, "job").uses, first.process.poll()) == (1, None)
        assert first.ended(signal.SIGTERM) == 5
        assert second.ended() == 4


@pytest.mark.e2e
def test_a_program_waits_for_as_long_as_it_was_told(arbiter_daemon: ArbiterProcess) -> None:
    """`--wait` did not count beside a pinned program: the answer was no at once."""
    with up(arbiter_daemon.environ, "--pin"):
        done = vramctl(
            "run", "--vram", "5GiB", "--wait", "0.2", "true", environ=arbiter_daemon.environ
        )
    assert done.returncode == 1
    assert "0.2 s" in done.stderr, done.stderr


@pytest.mark.e2e
def test_a_higher_priority_behind_an_equal_one_ends_the_program(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """The revoke was for the first of them, and no second one comes."""
    environ = arbiter_daemon.environ
    with up(environ) as run, job(environ, name="next", program="pass") as equal:
        run.said("next waits")
        lease = client.acquire(spec("b", 5), PATIENCE_S)
        assert run.ended() == 5
        run.said("b needs the room; ending it")
        lease.release()
        assert equal.ended() == 0


@pytest.mark.e2e
def test_an_operator_ends_the_program_although_it_keeps_another_waiting(
    arbiter_daemon: ArbiterProcess,
) -> None:
    environ = arbiter_daemon.environ
    with up(environ) as run, job(environ, name="next", program="pass") as equal:
        run.said("next waits")
        assert vramctl("evict", "job", "--reason", "lunch", environ=environ).returncode == 0
        assert run.ended() == 5
        run.said("lunch; ending it")
        assert equal.ended() == 0


@pytest.mark.e2e
def test_a_program_that_does_not_end_in_its_grace_is_killed(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    with up(arbiter_daemon.environ, "--grace", "0.1", program=DEAF) as run:
        client.acquire(spec("b", 5), PATIENCE_S)
        assert run.ended() == 128 + signal.SIGKILL


@pytest.mark.e2e
def test_run_is_pinned_only_on_request(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    with up(arbiter_daemon.environ, "--pin"):
        assert view_of(client, "job").evictable is False
    with up(arbiter_daemon.environ, "--priority", "60", "--on-revoke", "term") as run:
        assert view_of(client, "job").evictable is True
        client.acquire(spec("b", 5), PATIENCE_S)
        assert run.ended() == 5


# -- what it measured
@pytest.mark.e2e
@pytest.mark.anyio
async def test_the_peak_is_what_the_arbiter_measured_of_the_program(
    arbiter_daemon: ArbiterProcess, capfd: pytest.CaptureFixture[str]
) -> None:
    """The bytes of the program's process, charged to the lease of its parent; they are gone when
    the peak is said."""
    holder = (
        "import signal, sys; from pathlib import Path; "
        "from vram_arbiter.sidecars.device.fake import FakeMemory\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))\n"
        "FakeMemory(Path(sys.argv[1]), 'job', 0).allocate('x', 2 << 30); signal.pause()"
    )
    command = [sys.executable, "-c", holder, str(arbiter_daemon.gpu_folder)]
    spec = RunSpec(command, "job", 1 << 30, "any", 40, None, False, "priority", None)

    class Signals:
        def to(self, program: Program) -> None:
            self.program = program

    async with (
        asyncio.timeout(PATIENCE_S),
        AsyncClient("t", endpoint=arbiter_daemon.endpoint) as client,
    ):
        run, signals = Supervisor(spec, client, sys.executable), Signals()
        await run.acquire()
        await run.start(signals)
        ended = asyncio.create_task(run.until_ended())
        while not run.peak.seen_bytes:
            await asyncio.sleep(0.05)
        signals.program.send_signal(signal.SIGTERM)
        assert await ended == 0
    assert "peak 2 GiB measured of 1 GiB asked, more than was asked for" in capfd.readouterr().err
