"""A sidecar without its arbiter: told to do without, started before it, or attacked."""

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys

import pytest

from tests.support.attacks import WITHOUT_A_SESSION
from tests.support.paths import ROOT
from tests.support.running import attacked
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e

MB = 10**6


def test_without_an_arbiter_models_stay_and_the_last_one_does_not_fit(lone_box):
    detector = lone_box.start("detector", "--no-arbiter", footprint="5GB,5GB,100MB")
    until(lambda: detector.state() == "resident")
    grab = lone_box.start("grab", "--no-arbiter", footprint="4GB,4GB,100MB")
    failed = grab.detect()
    assert failed["code"] == "oom"
    assert grab.ask("ping")["last_error"].startswith("oom: CUDA out of memory (simulated)")
    assert detector.ask("load") == {
        "ok": True,
        "lease_id": None,
        "token": None,
        "loaded": False,
        "re": detector.client._id,
    }
    assert detector.terminate() == 0
    until(lambda: lone_box.used() <= 100 * MB)
    assert grab.detect()["ok"]


def test_a_process_without_a_device_needs_no_gpu(lone_box):
    sidecar = lone_box.start("detector", "--no-arbiter", device="none")
    assert sidecar.detect()["ok"]


@pytest.mark.parametrize("attack", WITHOUT_A_SESSION)
def test_an_attacked_sidecar_serves_others_and_lives(lone_box, attack):
    """Regression: bare connects, an odd identity or frames without end aborted the process, or took
    its memory."""
    sidecar = lone_box.start("detector", "--no-arbiter", device="none")
    assert sidecar.detect()["ok"]
    with attacked(sidecar.endpoint, attack) as attacker:
        for _ in range(20):
            assert sidecar.detect()["ok"]
        with WireClient(sidecar.endpoint) as another:
            assert another.ask("ping")["state"] == "resident"
        assert attacker.process.poll() is None
    assert sidecar.terminate() == 0


def test_two_sidecars_cannot_serve_one_socket(lone_box):
    lone_box.start("detector", "--no-arbiter", device="none")
    second = lone_box.spawn("detector", "--no-arbiter", device="none")
    assert second.process.wait(PATIENCE_S) == 1
    assert "already uses" in second.log


def test_without_the_arbiter_that_it_needs_it_says_so_and_ends(lone_box):
    sidecar = lone_box.spawn("detector")
    assert sidecar.process.wait(PATIENCE_S) == 1
    assert "no arbiter at" in sidecar.log
    assert "start `vram-arbiter`" in sidecar.log


def test_on_a_simulated_gpu_it_waits_for_the_arbiter_that_makes_the_gpu(box, arbiter_daemon):
    """Regression: the GPU's folder was read before the arbiter was asked for, so a sidecar started
    before its arbiter ended at once."""
    arbiter_daemon.stop()
    shutil.rmtree(box.gpu_folder)
    sidecar = box.spawn("detector")
    until(lambda: f"waiting for the arbiter at {arbiter_daemon.endpoint}" in sidecar.log)
    arbiter_daemon.start()
    assert sidecar.detect()["ok"]
    with WireClient(arbiter_daemon.endpoint) as client:
        (lease,) = client.hello("looker", role="observer").ask("status")["leases"]
    uuid = json.loads((box.gpu_folder / "gpu.json").read_text())["uuid"]
    assert lease["gpu"] == uuid, "the lease is of the GPU that holds the bytes"


@pytest.mark.parametrize(("kind", "flags"), [("lone_box", ["--no-arbiter"]), ("box", [])])
def test_without_its_simulated_gpu_it_tells_those_that_wait(kind, flags, request):
    """Regression: requests that came while it prepared were told that the sidecar "is ending", or
    that it "was told to unload". The cause stood in the log alone."""
    box = request.getfixturevalue(kind)
    sidecar = box.spawn("detector", *flags)
    (sidecar.folder / "slow_prepare").touch()
    assert sidecar.ask("ping")["ok"]
    waiting = [sidecar.send_detect(), sidecar.client.send("load")]
    until(lambda: sidecar.ask("ping").get("wanted"))
    shutil.rmtree(box.gpu_folder)
    (sidecar.folder / "slow_prepare").unlink()
    for request_id in waiting:
        reply = sidecar.client.reply(request_id)
        assert (reply["code"], reply["hint"]) == (
            "no_gpu",
            "start the arbiter with --gpu fake:8GiB",
        )
    assert sidecar.process.wait(PATIENCE_S) == 1


def started_anew(_, arguments, environ, output, errors):
    """Start the sidecar with a server of imports of its own."""
    echo = [sys.executable, str(ROOT / "tests/sidecars/echo_sidecar.py"), *arguments]
    return subprocess.Popen(echo, env=environ, stdout=output, stderr=errors)


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_its_end_in_the_middle_of_imports_ends_their_server(lone_box, how):
    """Regression: that server saw the end of its host once all was imported, up to 25 s later."""
    folder = lone_box.runtime / "eye-model"
    folder.mkdir()
    (folder / "endless.py").write_text(
        "import os, pathlib, threading\n"
        "pathlib.Path(__file__).with_name('importing').symlink_to(str(os.getpid()))\n"
        "threading.Event().wait()\n"
    )
    lone_box.environ["PYTHONPATH"] += f":{folder}"
    eye = lone_box.start("eye", "--no-arbiter", device="none", start=started_anew)
    until((folder / "importing").is_symlink)
    server = os.pidfd_open(int(os.readlink(folder / "importing")))
    try:
        eye.process.send_signal(how)
        assert eye.process.wait(PATIENCE_S) in (0, -how)
        assert select.select([server], [], [], PATIENCE_S)[0]
    finally:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(server, signal.SIGKILL)
        os.close(server)


def test_its_end_in_the_middle_of_a_load_is_in_order(lone_box):
    """Regression: the load that was undone and the unload both left the state `unloading`, and the
    program hung behind the assertion until it was killed."""
    (lone_box.runtime / "detector-model").mkdir()
    (lone_box.runtime / "detector-model" / "slow_load").touch()
    sidecar = lone_box.start("detector", "--no-arbiter")
    until(lambda: sidecar.state() == "loading" and lone_box.used() > 0)
    assert sidecar.terminate() == 0
    until(lambda: lone_box.used() == 0)
    assert "the load was undone" in sidecar.log
    assert "Traceback" not in sidecar.log
