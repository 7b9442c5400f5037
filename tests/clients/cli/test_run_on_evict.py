"""`vramctl run --on-evict`: programs that make room and come back, against a real daemon with a
simulated GPU, and stand-ins for model servers."""

import contextlib
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from tests.support.leases import Spec, view_of
from tests.support.process import ArbiterProcess, vramctl
from tests.support.processes import alive
from tests.support.running import Running, running
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.cli.run import check_gpus
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.wire.views import GpuView

pytestmark = pytest.mark.e2e
SERVER = (sys.executable, "-m", "tests.support.model_server")
PROGRAM = (
    "import os, signal, subprocess, sys, time; signal.signal(15, lambda *_: sys.exit(0)); "
    "child = subprocess.Popen(['sleep', '1000']); print(os.getpid(), child.pid, flush=True); "
    "time.sleep(1000)"
)
"""Its child outlives it."""
_PID = os.getpid()
HOST = f"127.{1 + _PID // 65536 % 250}.{_PID // 256 % 256}.{1 + _PID % 250}"
"""A loopback address of this test run alone: the port is named before the server is started."""
PORTS = itertools.count(20000)


def stand_in_job(arbiter: ArbiterProcess, *arguments: str) -> AbstractContextManager[Running]:
    """`vramctl run` of a program."""
    words = ("run", "--vram", "5GiB", "--name", "job", *arguments)
    return running("vramctl", words, arbiter.environ)


@contextlib.contextmanager
def server(
    arbiter: ArbiterProcess, action: str, *options: str, broken: Sequence[str] = ()
) -> Iterator[tuple[Running, int]]:
    """A stand-in server of 4 GiB under `vramctl run`, and its pid."""
    port = str(next(PORTS))
    command = [*SERVER, str(arbiter.gpu_folder), str(4 << 30), HOST, port, *broken]
    urls = [option.replace("URL", f"http://{HOST}:{port}") for option in options]
    with stand_in_job(arbiter, "--on-evict", action, *urls, "--", *command) as run:
        yield run, int(run.line())


def used_bytes(client: Client) -> int:
    """What the GPU's processes hold."""
    (gpu,) = client.status().gpus
    return sum(process.used_bytes or 0 for process in gpu.processes)


# -- stop
def test_a_stopped_program_is_started_again(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """Its child does not end with it, and is ended too: it could hold the memory."""
    program = [sys.executable, "-c", PROGRAM]
    with stand_in_job(arbiter_daemon, "--on-evict", "stop", "--", *program) as run:
        first, orphan = map(int, run.line().split())
        lease = client.acquire(spec("b", 5), PATIENCE_S)
        run.said("ending it")
        run.said("ended 1 of its processes")
        assert not alive(first)
        assert not alive(orphan)
        assert view_of(client, "job").state == "standby"
        lease.release()
        second, _ = map(int, run.line().split())
        assert second != first
        until(lambda: view_of(client, "job").state == "held")
        lease = client.acquire(spec("b", 5), PATIENCE_S)
        assert not alive(second)
        # nothing runs that could take it
        assert run.ended(signal.SIGTERM) == 128 + signal.SIGTERM
    until(lambda: [lease.consumer for lease in client.status().leases] == ["b"])


def test_a_stopped_program_that_ends_by_itself_ends_vramctl(arbiter_daemon: ArbiterProcess) -> None:
    done = vramctl(
        "run", "--vram", "1GiB", "--on-evict", "stop", "sh", "-c", "exit 6",
        environ=arbiter_daemon.environ,
    )  # fmt: skip
    assert done.returncode == 6


def test_a_program_does_not_outlive_a_killed_vramctl(arbiter_daemon: ArbiterProcess) -> None:
    """Regression: it went on without a lease, and a suspended one would have stayed for ever."""
    with stand_in_job(arbiter_daemon, "--", "sh", "-c", "echo $$; exec sleep 1000") as run:
        program = int(run.line())
        run.process.kill()
        until(lambda: not alive(program))


# -- servers
def test_a_server_frees_its_memory_and_takes_it_back(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """The same process all along; its weights are booked in host RAM, and any request may have its
    room."""
    with server(arbiter_daemon, "vllm", "--url", "URL", "--priority", "60") as (run, pid):
        lease = client.acquire(spec("b", 5), PATIENCE_S)
        run.said("freeing by vllm")
        assert (view_of(client, "job").state, view_of(client, "job").parked_bytes) == (
            "parked",
            5 << 30,
        )
        assert used_bytes(client) < 1 << 30
        lease.release()
        run.said("restored")
        until(lambda: used_bytes(client) > 4 << 30)
        assert view_of(client, "job").state == "held"
        order = ("evict", "job", "-r", "lunch")
        assert vramctl(*order, environ=arbiter_daemon.environ).returncode == 0
        assert "lunch" in run.said("freeing by vllm")
        run.said("restored")  # an operator's evict is no reason to stay away
        assert alive(pid)
        assert run.ended(signal.SIGTERM) == 0


def test_without_host_ram_a_server_that_needs_it_is_stopped(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec
) -> None:
    """Sleeping would take RAM that the arbiter has given to others."""
    arbiter = make_arbiter(config="host:\n  park_budget_bytes: 1GiB\n").start()
    with (
        Client("t", endpoint=arbiter.endpoint) as client,
        server(arbiter, "vllm", "--url", "URL") as (run, pid),
    ):
        lease = client.acquire(spec("b", 5), PATIENCE_S)
        run.said("no 5 GiB of host RAM for its weights; ending it")
        assert not alive(pid)
        lease.release()
        assert int(run.line()) != pid


def test_memory_that_a_server_does_not_free_is_not_granted(
    make_arbiter: Callable[..., ArbiterProcess], spec: Spec
) -> None:
    """The server answers 500. Nothing is ended for it; the waiter learns which bytes are in its
    way, and gets them when the server has ended."""
    arbiter = make_arbiter(config="verify:\n  timeout_s: 1\n").start()
    with (
        Client("t", endpoint=arbiter.endpoint) as client,
        server(arbiter, "comfyui", "--url", "URL", broken=["/free"]) as (run, pid),
        ThreadPoolExecutor(1) as pool,
    ):
        waiting = pool.submit(client.acquire, spec("b", 5), PATIENCE_S)
        told = run.said("vramctl status")
        assert "/free: answered 500: broken" in told
        assert "the arbiter measures what the program retains" in told

        def explained() -> bool:
            (entry,) = client.why("b").leases
            return "job" in entry.text and "keeps" in entry.text

        until(explained)
        assert (alive(pid), waiting.done()) == (True, False)
        assert run.ended(signal.SIGTERM) == 0
        waiting.result(PATIENCE_S).release()


def test_a_restore_that_fails_gives_the_lease_back_and_keeps_the_program(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    urls = ("--url", "URL/free", "--restore-url", "URL/restore")
    with server(arbiter_daemon, "http", *urls, broken=["/restore"]) as (run, pid):
        client.acquire(spec("b", 5), PATIENCE_S).release()
        told = run.said("continues without one")
        assert "/restore: answered 500: broken" in told
        until(lambda: not client.status().leases)
        assert alive(pid)
        assert run.ended(signal.SIGTERM) == 0


# -- options
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["http"], "needs --url"),
        (["http", "--url", "http://192.0.2.1/free"], "--allow-remote"),
        (["vllm", "--restore-url", "x"], "--restore-url has no effect with --on-evict vllm"),
        (["stop", "--url", "http://localhost/"], "--url has no effect with --on-evict stop"),
        (["cuda-checkpoint", "--allow-remote"], "--allow-remote has no effect"),
        (["stop", "--pin"], "leave out --on-evict stop"),
        (["end", "--timeout", "5"], "--timeout has no effect with --on-evict end"),
        (["park"], "invalid choice"),
    ],
)
def test_options_that_do_not_fit_together(
    options: list[str], said: str, arbiter_daemon: ArbiterProcess
) -> None:
    done = vramctl(
        "run", "--vram", "1GiB", "--on-evict", *options, "true", environ=arbiter_daemon.environ
    )
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr


@pytest.mark.skipif(Path("/dev/nvidiactl").exists(), reason="there is an NVIDIA driver")
def test_what_cuda_checkpoint_needs_is_checked_before_the_program_starts(
    arbiter_daemon: ArbiterProcess, tmp_path: Path
) -> None:
    done = vramctl(
        "run", "--vram", "1GiB", "--on-evict", "cuda-checkpoint", "touch", str(tmp_path / "began"),
        environ=arbiter_daemon.environ,
    )  # fmt: skip
    assert (done.returncode, "cuda-checkpoint needs" in done.stderr) == (1, True), done.stderr
    assert done.stderr.count("\n") == 1, "and nothing of a peak"
    assert not (tmp_path / "began").exists()


def test_a_program_that_lives_on_is_bound_to_one_gpu() -> None:
    """Its CUDA contexts are on the GPU that was granted first; the next grant could be another."""
    gpu = GpuView("GPU-1", 0, "x", "nvml", 8, 0, 0, 0, 0, 0.0, 0, None, ())
    check_gpus("any", [gpu])
    check_gpus("1", [gpu, gpu])
    with pytest.raises(ConfigError, match=r"2 GPUs.*name one with --gpu"):
        check_gpus("any", [gpu, gpu])
