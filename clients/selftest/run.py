"""A self-test's GPU and daemon, refused where they would disturb, and the verdict of each row."""

import asyncio
import os
import time
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Final, Literal

from vram_arbiter.clients.calibration.gpu import Gpu, open_gpu
from vram_arbiter.clients.cli.doctor.machine import ask_arbiter, ask_nvml
from vram_arbiter.clients.cli.programs import private_arbiter
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.selftest.bed import READING_S, Bed, Missed, Skipped
from vram_arbiter.clients.selftest.rows import Claim
from vram_arbiter.schemas.defaults import RESERVE_BYTES
from vram_arbiter.schemas.errors import CheckpointUnsupported, ConfigError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime import endpoints
from vram_arbiter.schemas.runtime.extras import NotInstalled
from vram_arbiter.schemas.runtime.threads import answered_within
from vram_arbiter.schemas.sizes import format_bytes

type Verdict = Literal["pass", "miss", "failed", "skipped"]

SIMULATED: Final = "fake:8GiB"
AUTO, FAKE = "auto", "fake"
NO_DRIVER: Final = ("NVMLError_LibraryNotFound", "NVMLError_DriverNotLoaded")


async def opened(wanted: str, memory_bytes: int) -> tuple[Gpu | None, str]:
    """Open the GPU of this number, the first for AUTO; None: a simulated one, and why.

    Raises ConfigError where it is leased, or has no room or no memory of its own, NoGpu, and
    ProbeFailed.
    """
    if wanted == FAKE:
        return None, "--gpu fake"
    nvml = await answered_within(READING_S, ask_nvml)
    if wanted == AUTO and nvml.error in NO_DRIVER:
        return None, nvml.problem
    if nvml.without_memory:
        raise ConfigError(
            "this GPU uses the machine's memory, of which no row can tell its own part",
            hint="vramctl selftest --gpu fake; vramctl doctor examines the machine",
        )
    device = f"cuda:{0 if wanted == AUTO else wanted}"
    gpu = await answered_within(READING_S, lambda: open_gpu(device))
    if (endpoint := leased_at(gpu.uuid)) is not None:
        raise ConfigError(
            f"the arbiter at {endpoint} leases {gpu.name} ({gpu.uuid}), or does not say",
            hint="stop it (systemctl stop vram-arbiter), or name another GPU with --gpu",
        )
    free_bytes = gpu.total_bytes - (await answered_within(READING_S, gpu.read)).used_bytes
    if free_bytes < memory_bytes + RESERVE_BYTES:
        raise ConfigError(
            f"{gpu.name} has {format_bytes(free_bytes)} free, and {format_bytes(memory_bytes)} "
            f"beside the reserve of {format_bytes(RESERVE_BYTES)} are needed",
            hint="end a program that uses it (nvidia-smi lists them), or choose a smaller --memory",
        )
    return gpu, ""


def leased_at(uuid: str, environ: Mapping[str, str] = os.environ) -> str | None:
    """Return the endpoint of an arbiter of this machine that leases a GPU, or does not answer;
    None: there is none. This user's and the system's are asked."""
    asked = [endpoints.EXAMPLE]
    with suppress(ConfigError):  # this user has no folder for sockets, and no arbiter
        asked.insert(0, endpoints.arbiter_endpoint(environ, os.getuid()))
    for endpoint in filter(is_listening, asked):
        status = ask_arbiter(endpoint).status
        if status is None or uuid in [view.gpu for view in status.gpus]:
            return endpoint
    return None


@asynccontextmanager
async def made(gpu: Gpu | None, memory_bytes: int, skills: Collection[str]) -> AsyncIterator[Bed]:
    """Start a daemon on a GPU (None: a simulated one); end it and all other children with the
    block. Raises NoGpu, ProbeFailed, and what `private_arbiter` raises."""
    source = "nvml" if gpu else SIMULATED
    async with private_arbiter("selftest", source) as (programs, client):
        gpu = gpu or open_gpu(f"fake:{programs.log_dir}/fakegpu")
        programs.environ |= gpu.environ
        found = await answered_within(READING_S, gpu.read)
        yield Bed(gpu, found, memory_bytes, programs, client, skills)


async def judged(row: Claim, bed: Bed, left_s: float) -> JsonMap:
    """Measure one row in `left_s` at most. Never raises: a row that fails hides no other.

    Returns:
        What the row found, as in the output of `--json`. `figure` None: none was measured; `limit`
        empty: it has none here.
    """
    limit = "" if row.timed_model and bed.simulated else row.limit
    began_s, limit_s, figure = time.monotonic(), min(row.limit_s, left_s), None
    verdict: Verdict = "failed"
    try:
        if row.hardware and bed.simulated:
            raise Skipped("needs an NVIDIA GPU")
        if left_s <= 0:
            raise Skipped("no time was left: see --within")
        async with asyncio.timeout(limit_s):
            measured, remark = await row.measure(bed)
        figure = float(f"{measured:.4g}")
        verdict = "pass" if not limit or row.least <= figure <= row.most else "miss"
    except (Skipped, NotInstalled, CheckpointUnsupported) as why:
        verdict, remark = "skipped", str(why)
    except Missed as why:
        verdict, remark = "miss", str(why)
    except TimeoutError:
        cut = "" if limit_s == row.limit_s else ", which was all that was left: see --within"
        remark = f"no result within {limit_s:.0f} s{cut}"
    except Exception as error:  # noqa: BLE001  a defect of one row is a result, too
        remark = f"{type(error).__name__}: {error}"
    return {
        "id": row.id, "what": row.what, "figure": figure, "unit": row.unit, "limit": limit,
        "source": row.source, "verdict": verdict, "remark": remark,
        "seconds": round(time.monotonic() - began_s, 3),
    }  # fmt: skip
