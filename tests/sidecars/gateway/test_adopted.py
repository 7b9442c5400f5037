"""A unit that runs already when the gateway starts, beside a real daemon. `systemctl` is a small
program on PATH; the real one runs in tests/packaging/test_units_start.py."""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("aiohttp", reason="the extra `gateway`")

import httpx

from tests.clients.foreign.test_service import SYSTEMCTL
from tests.sidecars.gateway.conftest import GatewayProcess
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.ports import free_port

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.e2e,
    pytest.mark.skipif(procfs.cgroup_root() is None, reason="no cgroup v2 hierarchy is mounted"),
]
UNIT = "llm.service"


@pytest.mark.parametrize("wanted", [False, True])
async def test_a_unit_that_ends_while_its_lease_waits_is_started_for_a_request_alone(
    gateway: Callable[..., GatewayProcess],
    arbiter_daemon: ArbiterProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wanted: bool,
) -> None:
    """Regression: it was started at the grant, though no request was for it."""
    folder = tmp_path / "units"
    folder.mkdir()
    (folder / f"{UNIT}.shown").write_text(f"Id={UNIT}\nLoadState=loaded\nSlice=system.slice\n")
    runs = folder / f"{UNIT}.runs"
    runs.write_text(f"/system.slice/{UNIT}\n")
    program = folder / "systemctl"
    program.write_text(SYSTEMCTL.replace("#!/bin/sh\n", f"#!/bin/sh\ncd {folder}\n"))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")

    def started() -> bool:
        return f"start -- {UNIT}" in (folder / "calls").read_text()

    server = {"unit": UNIT, "port": free_port(), "vram": "5GiB", "wait_s": PATIENCE_S}
    with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
        lease = arbiter.acquire(vram="5GiB", priority=90)
        with lease.use("busy"):
            made = gateway({"llm": server})
            await eventually(lambda: arbiter.status().totals.waiting == 1)
            runs.unlink()
            async with httpx.AsyncClient(base_url=made.url, timeout=PATIENCE_S) as client:
                if not wanted:
                    lease.release()
                    await eventually(lambda: not arbiter.status().leases)
                    assert not started()
                    assert not made.running()
                    return
                request = asyncio.create_task(client.get("/upstream/llm/x"))
                await eventually(lambda: made.running()["llm"]["waiting"] == 1)
                lease.release()
                await eventually(started)
                request.cancel()
