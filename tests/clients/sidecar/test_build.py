"""Sidecars from manifests: started where none serves, kept alive, and ended with their program."""

import asyncio
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.sidecars.conftest import MANIFEST, PNG
from tests.support import prepared
from tests.support.paths import CONFIGS, ROOT
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.sidecar.build import build, manifest_file, served
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

PARENT = """
import asyncio, sys
from vram_arbiter.clients.sidecar.build import served
from vram_arbiter.clients.sidecar.perception import DetectorClient

async def main():
    client = DetectorClient(sys.argv[1])
    async with served(client, sys.argv[2:]):
        print(client.identity["pid"], flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="sb") as folder:
        monkeypatch.setenv("VRAM_ARBITER_RUNTIME", folder)
        monkeypatch.setenv("PYTHONPATH", f"{ROOT}/src:{ROOT}")
        yield Path(folder)


@pytest.fixture
def command(runtime: Path) -> list[str]:
    """A sidecar around a model without weights."""
    (runtime / "rskill.yaml").write_text(MANIFEST.format(name="eye"))
    return [
        sys.executable, "-m", "tests.sidecars.echo_sidecar", str(runtime), "--name", "eye",
        "--rskill", f"{runtime}/rskill.yaml", "--device", "none", "--no-arbiter",
        "--footprint", "1GB",
    ]  # fmt: skip


async def until_ended(pid: int) -> None:
    """Wait for the end of a process that need not be a child of this one."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        ended, _, _ = await asyncio.to_thread(select.select, [pidfd], [], [], PATIENCE_S)
    finally:
        os.close(pidfd)
    assert ended, f"process {pid} still runs"


async def test_a_child_serves_comes_back_and_ends_with_the_block(
    runtime: Path, command: list[str]
) -> None:
    client = DetectorClient(f"ipc://{runtime}/eye.sock", connect_timeout_s=PATIENCE_S)
    async with served(client, command):
        first = client.identity["pid"]
        await client.detect(PNG, "cube")
        os.kill(first, signal.SIGKILL)
        await until_ended(first)
        await client.close()  # the next call connects anew
        await client.detect(PNG, "cube")
        second = client.identity["pid"]
        assert second != first
    await until_ended(second)


async def test_a_child_ends_with_its_parent_that_is_killed(
    runtime: Path, command: list[str]
) -> None:
    arguments = [sys.executable, "-c", PARENT, f"ipc://{runtime}/eye.sock", *command]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as parent:
        pid = int(await asyncio.to_thread(parent.stdout.readline))
        parent.kill()
    await until_ended(pid)


async def test_another_programs_sidecar_is_used_and_left_running(runtime: Path) -> None:
    endpoint = f"ipc://{runtime}/eye.sock"
    process = prepared.start("op-server", [endpoint], os.environ)
    try:
        async with DetectorClient(endpoint, connect_timeout_s=PATIENCE_S) as client:
            await client.load()
        async with served(DetectorClient(endpoint), ["no-such-program"]):
            pass
        with pytest.raises(ConfigError, match="serves None, not vram-arbiter/so101-detector"):
            async with build(
                CONFIGS / "rskills/so101-detector/rskill.yaml", DetectorClient, name="eye"
            ):
                pass  # fmt: skip
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["/no/such/python"], "cannot start /no/such/python: No such file or directory"),
        (
            [sys.executable, "-c", "raise SystemExit(3)", "--name", "eye"],
            r"ended with exit code 3 \(.*`vram-sidecar --name eye --check` lists what is missing",
        ),
    ],
)
async def test_what_cannot_start_is_an_error_that_says_what_to_do(
    runtime: Path, command: list[str], said: str
) -> None:
    with pytest.raises(SidecarUnavailable, match=said):
        async with served(DetectorClient(f"ipc://{runtime}/eye.sock"), command):
            pytest.fail("nothing serves")


async def test_a_manifest_of_another_kind_is_refused() -> None:
    file = manifest_file("so101-detector")
    assert file.samefile(CONFIGS / "rskills/so101-detector/rskill.yaml")
    assert manifest_file(str(file.parent)) == file
    assert manifest_file("ipc:///run/eye.sock") is None
    with pytest.raises(ConfigError, match="so101-detector is a detector, expected a vlm"):
        async with build(file, SceneVlmClient):
            pass
    with pytest.raises(ConfigError, match="is a ros_action, expected a reward"):
        async with build(CONFIGS / "rskills/so101-move/rskill.yaml", RewardClient):
            pass


@pytest.mark.heavy
async def test_a_manifest_comes_to_a_sidecar_under_the_arbiter(
    arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in arbiter_daemon.environ.items():
        monkeypatch.setenv(name, value)
    file = CONFIGS / "rskills/so101-detector/rskill.yaml"
    async with build(file, DetectorClient) as client:
        assert client.endpoint == f"ipc://{arbiter_daemon.runtime}/detector.sock"
        assert (await client.ping())["rskill"] == "vram-arbiter/so101-detector"
