"""The daemon as an operator meets it: flags, exit codes, start, stop, notifications. Real
processes."""

import contextlib
import os
import re
import signal
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.prepared import run
from tests.support.process import ArbiterProcess, Make
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e


def run_daemon(
    arbiter: ArbiterProcess, *arguments: str, **environ: str
) -> "subprocess.CompletedProcess[str]":
    """`vram-arbiter` with exactly these flags, to its end."""
    return run("vram-arbiter", arguments, {**arbiter.environ, **environ}, PATIENCE_S)


def test_help_documents_the_exit_codes(make_arbiter: Make) -> None:
    done = run_daemon(make_arbiter(), "--help")
    assert done.returncode == 0
    for code in ("0", "2", "3", "4", "70"):
        assert re.search(rf"^  {code} +\w", done.stdout, re.MULTILINE), (
            f"exit code {code} is not documented"
        )


def test_version_and_check_config(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    assert run_daemon(arbiter, "--version").stdout.startswith("vram-arbiter ")
    example = Path(__file__).parents[2] / "configs" / "arbiter.yaml"
    done = run_daemon(arbiter, "--check-config", "--config", str(example))
    assert (done.returncode, done.stderr) == (0, "")
    assert f"ok (would serve {arbiter.endpoint}" in done.stdout


def test_a_typo_in_the_configuration_is_named_with_its_line(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="verify:\n  tiemout_s: 3\n")
    done = run_daemon(arbiter, *arbiter.arguments)
    assert done.returncode == 2
    assert "arbiter.yaml:2: verify.tiemout_s: unknown key; did you mean timeout_s?" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gpu", "cuda"], "write auto, nvml, unified, drm, fake:8GiB"),
        (["--gpu", "fake:lots"], "not a size"),
        (["--gpu", "fake:100MiB"], "leaves nothing of"),
        (["--gpu", "fake:0"], "a GPU without memory"),
        (["--gpu", "fake:/dev/null"], "the simulated GPU in /dev/null cannot be used"),
        (["--gpu", "fake:8GX", "--check-config"], "not a size"),
        (["--endpoint", "tcp://127.0.0.1:5555"], "without CURVE keys"),
        (["--config", "/nonexistent/arbiter.yaml"], "readable YAML file"),
        (["--state-dir", "/proc/nonexistent", "--gpu", "fake:8GiB"], "this program may write"),
        (["--nonsense"], "unrecognized arguments"),
    ],
)
def test_wrong_flags_end_with_2_and_say_what_to_do(
    make_arbiter: Make, arguments: list[str], words: str
) -> None:
    """Regression: `--gpu fake:0` ended with a traceback and exit code 1, which systemd retries."""
    done = run_daemon(make_arbiter(), *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_cap_on_a_gpu_that_is_not_there(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="gpu:\n  capacity_bytes: {'7': 4GiB}\n")
    done = run_daemon(arbiter, *arbiter.arguments, "--gpu", "fake:8GiB")
    assert done.returncode == 2
    assert "names no GPU of this machine: 7" in done.stderr


@pytest.mark.skipif(os.path.exists("/dev/nvidiactl"), reason="this machine has an NVIDIA driver")
def test_without_a_driver_nothing_is_simulated_unasked(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    done = run_daemon(arbiter, "--state-dir", str(arbiter.state))
    assert done.returncode == 4
    assert "--gpu fake:8GiB" in done.stderr
    assert "Traceback" not in done.stderr
    assert not arbiter.gpu_folder.exists()
    assert not (arbiter.runtime / "arbiter.sock").exists()


def test_a_second_daemon_on_the_socket_is_refused_and_the_first_serves_on(
    arbiter_daemon: ArbiterProcess, connect: Callable[..., WireClient]
) -> None:
    client = connect().hello()
    lease = client.granted("holder", GIB)
    done = run_daemon(
        arbiter_daemon, "--gpu", "fake:8GiB", "--state-dir", str(arbiter_daemon.runtime / "other")
    )
    assert done.returncode == 3
    assert f"pid {arbiter_daemon.pid}" in done.stderr
    assert [found["lease_id"] for found in client.ask("status")["leases"]] == [lease["lease_id"]]
    assert connect().hello().ask("ping")["ok"], "new connections still reach the first"


def test_a_second_daemon_on_the_state_folder_is_refused(arbiter_daemon: ArbiterProcess) -> None:
    endpoint = f"ipc://{arbiter_daemon.runtime}/other.sock"
    done = run_daemon(
        arbiter_daemon,
        "--gpu",
        "fake:8GiB",
        "--endpoint",
        endpoint,
        "--state-dir",
        str(arbiter_daemon.state),
    )
    assert done.returncode == 3
    assert f"pid {arbiter_daemon.pid}" in done.stderr


def test_a_configuration_that_others_may_write_is_refused(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    file = arbiter.runtime / "arbiter.yaml"
    file.write_text("log: {level: debug}\n")
    file.chmod(0o666)
    done = run_daemon(arbiter, "--check-config", "--config", str(file))
    assert (done.returncode, f"{file} may be written by other users" in done.stderr) == (2, True)
    file.chmod(0o644)
    assert run_daemon(arbiter, "--check-config", "--config", str(file)).returncode == 0


@pytest.mark.parametrize("second", [True, False])
def test_a_daemon_whose_socket_and_locks_were_deleted_serves_alone(
    make_arbiter: Make, second: bool
) -> None:
    """A second daemon served beside it, and both granted the same memory. The first ends; where
    there is no second, none can start any more."""
    first = make_arbiter().start({"WATCHDOG_USEC": "900000"})
    os.kill(first.pid, signal.SIGSTOP)  # it notices nothing until the second one serves
    for name in ("arbiter.sock", "arbiter.sock.lock", "state/lock"):
        (first.runtime / name).unlink()
    if not second:
        os.kill(first.pid, signal.SIGCONT)
        until(lambda: "state/lock was deleted; locked again" in first.log)
        done = run_daemon(first, "--gpu", "fake:8GiB", "--state-dir", str(first.state))
        assert done.returncode == 3
        assert f"pid {first.pid}" in done.stderr
        return
    other = subprocess.Popen(first.command(), env=first.environ, stderr=subprocess.DEVNULL)
    try:
        until((first.runtime / "arbiter.sock").exists)
        os.kill(first.pid, signal.SIGCONT)
        assert first.process.wait(PATIENCE_S) == 3
        assert first.log.count(f"stopping: an arbiter (pid {other.pid}) already uses") == 1
        with WireClient(first.endpoint) as client:
            assert client.hello().ask("ping")["ok"], "the second one's socket stays"
    finally:
        other.terminate()
        other.wait(PATIENCE_S)


def test_the_environment_names_the_endpoint_and_the_flag_wins(make_arbiter: Make) -> None:
    arbiter = make_arbiter()
    other = f"ipc://{arbiter.runtime}/by-variable.sock"
    flag = f"ipc://{arbiter.runtime}/by-flag.sock"
    arguments = ["--check-config", "--gpu", "fake:8GiB"]
    assert other in run_daemon(arbiter, *arguments, VRAM_ARBITER_ENDPOINT=other).stdout
    assert (
        flag
        in run_daemon(arbiter, *arguments, "--endpoint", flag, VRAM_ARBITER_ENDPOINT=other).stdout
    )


@pytest.mark.parametrize("number", ["TERM", "INT"])
def test_an_orderly_stop(make_arbiter: Make, number: str) -> None:
    arbiter = make_arbiter().start()
    assert (arbiter.runtime / "arbiter.sock").exists()
    arbiter.process.send_signal(getattr(signal, f"SIG{number}"))
    assert arbiter.process.wait(PATIENCE_S) == 0
    assert not (arbiter.runtime / "arbiter.sock").exists()
    arbiter.wait_for("STOPPING=1", PATIENCE_S)
    assert "Traceback" not in arbiter.log


def test_the_watchdog_is_fed_and_the_status_tells(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start({"WATCHDOG_USEC": "300000"})
    for _ in range(3):
        arbiter.wait_for("WATCHDOG=1", PATIENCE_S)
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        assert "Simulated GPU (8 GiB); 1 clients" in arbiter.wait_for("1 clients", PATIENCE_S)


def test_a_status_that_the_manager_had_no_room_for_is_told_again(make_arbiter: Make) -> None:
    """Regression: a full disk was in `vramctl status`, and never in `systemctl status`."""
    arbiter = make_arbiter().start({"WATCHDOG_USEC": "300000"})
    with (
        WireClient(arbiter.endpoint) as client,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as another,
    ):
        another.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                another.sendto(b"EXTEND_TIMEOUT_USEC=1", str(arbiter.runtime / "notify.sock"))
        began_s = client.hello().ask("status")["uptime_s"]
        while client.ask("status")["uptime_s"] < began_s + 1.0:  # ten beats
            client.receive(0.1)
        assert "1 clients" in arbiter.wait_for("1 clients", PATIENCE_S)


def test_a_cap_and_a_reserve_from_the_file_are_the_budget(make_arbiter: Make) -> None:
    config = "gpu:\n  reserve_bytes: 1GiB\n  capacity_bytes: {'0': 4GiB}\n"
    arbiter = make_arbiter(config=config).start()
    with WireClient(arbiter.endpoint) as client:
        gpu = client.hello().ask("status")["gpus"][0]
        assert (gpu["capacity_bytes"], gpu["reserve_bytes"]) == (4 * GIB, GIB)
        refused = client.acquire("big", 3 * GIB + 1)
        assert refused["error"]["code"] == "vram_insufficient"
        assert refused["error"]["details"]["capacity_bytes"] == 4 * GIB
        assert client.acquire("fits", 3 * GIB)["ok"]
