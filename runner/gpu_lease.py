"""A small lease for what the runner itself puts on a GPU: rendering by EGL, decoding of cameras.

Without it the arbiter would see a process with bytes and no lease. The lease is pinned, because a
renderer or decoder cannot be unloaded while the runner works. It is taken on a GPU that the arbiter
has, and on no other: MuJoCo renders on a CPU or another GPU where there is one.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import uuid
from collections.abc import AsyncIterator, Mapping

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.cuda import instance
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.wire.spec import Footprint

log = logging.getLogger(__name__)

RENDERING, DECODING = "mujoco-egl", "gstreamer-decoders"
RENDERER_BYTES = 512 * MIB  # a driver's EGL context with a few off-screen buffers
DECODER_BYTES = 384 * MIB  # of each camera: a CUDA context and a decoder's surfaces
WAIT_S = 60.0
DEVICES_MAX = 16
_EGL_CUDA_DEVICE_NV = 0x323A
_EGL_TRUE = 1


@contextlib.asynccontextmanager
async def gpu_lease(
    arbiter: AsyncClient | None, gpu: str | None, model: str, needed_bytes: int
) -> AsyncIterator[None]:
    """While inside, a lease of `needed_bytes` is held on `gpu` (a UUID), if the arbiter has it.

    It counts as loaded at once, so that it blocks no model's load. At its end the process may still
    hold a driver's context: the arbiter is told that the process ends.
    Raises VramInsufficient, WaitTimeout and others of `AsyncClient.acquire`.
    """
    if arbiter is None or gpu is None or not needed_bytes:
        yield
        return
    if gpu not in {one.gpu for one in (await arbiter.status()).gpus}:
        log.info("%s: GPU %s is not the arbiter's, and is not leased", model, gpu)
        yield
        return
    lease = await arbiter.acquire(
        wait_timeout_s=WAIT_S,
        vram=Footprint(needed_bytes, needed_bytes),
        model=model,
        gpu=gpu,
        evictable=False,
    )
    await lease.ready(needed_bytes)
    log.info("%s: %d MiB are leased on GPU %s", model, needed_bytes // MIB, gpu)
    try:
        yield
    finally:
        await lease.release(exiting=True)


def rendering_gpu(environ: Mapping[str, str]) -> str | None:
    """Return the UUID of the NVIDIA GPU that MuJoCo renders on here; None: on no such GPU.

    Asks EGL for its devices as `mujoco.egl` does, without opening a display or a CUDA context.
    """
    if environ.get("MUJOCO_GL", "egl").lower() != "egl":
        return None
    ordinal = _egl_cuda_ordinal(environ.get("MUJOCO_EGL_DEVICE_ID", "0"))
    return None if ordinal is None else cuda_uuid(ordinal)


def _egl_cuda_ordinal(chosen: str) -> int | None:
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return None
    address = egl.eglGetProcAddress
    address.restype, address.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    query, attribute = address(b"eglQueryDevicesEXT"), address(b"eglQueryDeviceAttribEXT")
    if not query or not attribute or not chosen.isascii() or not chosen.isdigit():
        return None
    devices, count = (ctypes.c_void_p * DEVICES_MAX)(), ctypes.c_int()
    ask = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )(query)
    listed = ask(DEVICES_MAX, devices, ctypes.byref(count))
    if listed != _EGL_TRUE or int(chosen) >= count.value:
        return None
    value = ctypes.c_ssize_t()
    tell = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_ssize_t)
    )(attribute)
    told = tell(devices[int(chosen)], _EGL_CUDA_DEVICE_NV, ctypes.byref(value))
    return value.value if told == _EGL_TRUE else None  # a device of another maker, or a CPU


def cuda_uuid(ordinal: int) -> str | None:
    """Return the UUID of a CUDA device as NVML writes it; None without CUDA or such a device."""
    if (named := instance(os.environ)) is not None:
        return named
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return None
    device, raw = ctypes.c_int(), (ctypes.c_ubyte * 16)()
    failed = (
        cuda.cuInit(0)
        or cuda.cuDeviceGet(ctypes.byref(device), ordinal)
        or cuda.cuDeviceGetUuid(raw, device)
    )
    if failed:
        return None
    return f"GPU-{uuid.UUID(bytes=bytes(raw))}"
