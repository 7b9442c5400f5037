"""What the runner itself puts on a GPU: which GPU that is, and its lease at a real arbiter."""

import os
from pathlib import Path

import pytest

from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.runner.gpu_lease import (
    RENDERER_BYTES,
    RENDERING,
    cuda_uuid,
    gpu_lease,
    rendering_gpu,
)
from vram_arbiter.schemas.wire.views import LeaseView

pytestmark = pytest.mark.anyio


async def test_rendering_holds_a_small_pinned_lease(arbiter_daemon: ArbiterProcess) -> None:
    async with AsyncClient("runner", endpoint=arbiter_daemon.endpoint) as client:

        async def leases() -> list[LeaseView]:
            return list((await client.status()).leases)

        gpu = (await client.status()).gpus[0].gpu
        async with gpu_lease(client, gpu, RENDERING, RENDERER_BYTES):
            (lease,) = await leases()
            assert (lease.consumer, lease.model, lease.gpu) == ("runner", "mujoco-egl", gpu)
            assert (lease.state, lease.evictable) == ("held", False)  # no load waits for it
            assert lease.charge_bytes >= RENDERER_BYTES
        assert not [one for one in await leases() if one.state == "held"]
        for other in ("GPU-another", None):
            async with gpu_lease(client, other, RENDERING, RENDERER_BYTES):
                assert not [one for one in await leases() if one.state == "held"]


def test_a_renderer_on_a_cpu_is_on_no_gpu() -> None:
    assert rendering_gpu({"MUJOCO_GL": "osmesa"}) is None
    assert rendering_gpu({"MUJOCO_EGL_DEVICE_ID": "99"}) is None
    if not Path("/proc/driver/nvidia/version").exists():
        assert (rendering_gpu(os.environ), cuda_uuid(0)) == (None, None)
