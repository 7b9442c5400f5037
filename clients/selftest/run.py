"""A self-test from its first reading to its last: refused where it would disturb, each row judged
by itself."""

import asyncio
import os
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from vram_arbiter.clients.calibration.gpu import Gpu, Reading, open_gpu
from vram_arbiter.clients.cli.demo_programs import Programs
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.net.request import ask
from vram_arbiter.clients.selftest.bed import READING_S, Bed, Missed, Skipped, answered_within
from vram_arbiter.clients.selftest.rows import BEAT_S, LAST, Claim
from vram_arbiter.schemas.defaults import RESERVE_BYTES, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    ConfigError,
    SidecarUnavailable,
    VramError,
)
from vram_arbiter.schemas.runtime import endpoints
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.requests import Status

type Verdict = Literal["pass", "miss", "failed", "skipped"]

START_S: Final = 30.0
SIMULATED: Final = "fake:8GiB"


@dataclass(frozen=True, slots=True)
class Trial:
    """What is asked for. `index` None: a simulated GPU."""

    index: int | None
    memory_bytes: int
    within_s: float
    rows: Sequence[Claim]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a row found. `figure` None: none was measured; `limit` "": it has none here."""

    id: str
    what: str
    figure: float | None
    unit: str
    limit: str
    source: str
    verdict: Verdict
    remark: str
    seconds: float = 0.0


async def selftest(
    wanted: Trial, begun: Callable[[Gpu], None], tell: Callable[[Outcome], None]
) -> None:
    """Measure all rows, and tell each result as it comes; `begun` is told the GPU before.

    Raises ConfigError where the GPU is leased or has no room, NoGpu, ProbeFailed, and
    SidecarUnavailable where the daemon does not start.
    """
    deadline_s = time.monotonic() + wanted.within_s
    # short, for the paths of its sockets
    with tempfile.TemporaryDirectory(prefix="vram-st", ignore_cleanup_errors=True) as folder:
        async with _made(wanted, folder) as bed:
            begun(bed.gpu)
            for row in wanted.rows:
                tell(await judged(row, bed, deadline_s - time.monotonic()))
        tell(await judged(LAST, bed, LAST.limit_s))


@asynccontextmanager
async def _made(wanted: Trial, folder: str) -> AsyncIterator[Bed]:
    """Read the GPU, and start a daemon on it; end that and all other children with the block."""
    gpu, found = await _open(wanted)
    endpoint = f"ipc://{folder}/arbiter.sock"
    environ = {endpoints.RUNTIME_VARIABLE: folder, endpoints.ENDPOINT_VARIABLE: endpoint}
    programs = Programs(Path(folder), environ | {"TMPDIR": folder})
    source = SIMULATED if gpu is None else "nvml"
    daemon = ("--gpu", source, "--state-dir", f"{folder}/state")
    try:
        await programs.start("arbiter", "arbiter", *daemon)
        async with AsyncClient("selftest", endpoint=endpoint, connect_timeout_s=START_S) as client:
            gpu = gpu or open_gpu(f"fake:{folder}/fakegpu")
            programs.environ = {**programs.environ, **gpu.environ}
            async with asyncio.timeout(START_S):
                room = await room_on(client, gpu.uuid)
            skills = {row.skill for row in wanted.rows if row.skill}
            found = found or gpu.read()
            yield Bed(gpu, found, wanted.memory_bytes, room, programs, client, daemon, skills)
    except (ArbiterUnreachable, TimeoutError) as error:
        programs.check()  # says why it ended
        raise SidecarUnavailable(
            "the daemon does not read the GPU", hint="vramctl doctor"
        ) from error
    finally:
        await programs.stop_all()


async def _open(wanted: Trial) -> tuple[Gpu | None, Reading | None]:
    """Open a real GPU and read it, if it may be used; the daemon makes a simulated one. Raises
    ConfigError, NoGpu, ProbeFailed."""
    if wanted.index is None:
        return None, None
    gpu = await answered_within(READING_S, lambda: open_gpu(f"cuda:{wanted.index}"))
    if (endpoint := leased_at(gpu.uuid)) is not None:
        raise ConfigError(
            f"the arbiter at {endpoint} leases {gpu.name} ({gpu.uuid}), or does not say",
            hint="stop it (systemctl stop vram-arbiter), or name another GPU with --gpu",
        )
    found = await answered_within(READING_S, gpu.read)
    free_bytes, needed_bytes = gpu.total_bytes - found.used_bytes, wanted.memory_bytes
    if free_bytes < needed_bytes + RESERVE_BYTES:
        raise ConfigError(
            f"{gpu.name} has {format_bytes(free_bytes)} free, and {format_bytes(needed_bytes)} "
            f"beside the reserve of {format_bytes(RESERVE_BYTES)} are needed",
            hint="end a program that uses it (nvidia-smi lists them), or choose a smaller --memory",
        )
    return gpu, found


def leased_at(uuid: str, environ: Mapping[str, str] = os.environ) -> str | None:
    """Return the endpoint of an arbiter of this machine that leases a GPU, or does not answer;
    None: there is none. This user's and the system's are asked."""
    asked = [endpoints.EXAMPLE]
    with suppress(ConfigError):  # this user has no folder for sockets, and no arbiter
        asked.insert(0, endpoints.arbiter_endpoint(environ, os.getuid()))
    for endpoint in filter(is_listening, asked):
        try:
            leased = [view["gpu"] for view in ask(Status(), endpoint)["gpus"]]
        except (VramError, KeyError):
            return endpoint
        if uuid in leased:
            return endpoint
    return None


async def room_on(client: AsyncClient, gpu: str) -> int:
    """Return the bytes that the daemon can lease now, less what the driver may take meanwhile: two
    leases of so many never fit. Raises ConfigError for a GPU that it does not lease."""
    while True:
        views = {one.gpu: one for one in (await client.status()).gpus}
        if (view := views.get(gpu)) is None:
            raise ConfigError(
                f"the daemon leases {', '.join(views)}, not {gpu}: is it split into instances?",
                hint="name another GPU with --gpu",
            )
        if view.measured_used_bytes is not None:
            left = view.capacity_bytes - view.reserve_bytes - view.stowaway_bytes
            return left - 2 * VERIFY_TOLERANCE_BYTES
        await asyncio.sleep(BEAT_S)


async def judged(row: Claim, bed: Bed, left_s: float) -> Outcome:
    """Measure one row in `left_s` at most. Never raises: a row that fails hides no other."""
    limit = "" if row.timed_model and bed.simulated else row.limit
    began_s, limit_s = time.monotonic(), min(row.limit_s, left_s)

    def result(verdict: Verdict, remark: str, figure: float | None = None) -> Outcome:
        seconds, of = round(time.monotonic() - began_s, 3), (row.unit, limit, row.source)
        return Outcome(row.id, row.what, figure, *of, verdict, remark, seconds)

    try:
        if row.hardware and bed.simulated:
            raise Skipped("needs an NVIDIA GPU")
        if left_s <= 0:
            raise Skipped("no time was left: see --within")
        async with asyncio.timeout(limit_s):
            figure, remark = await row.measure(bed)
        figure = float(f"{figure:.4g}")
        holds = not limit or row.least <= figure <= row.most
        return result("pass" if holds else "miss", remark, figure)
    except Skipped as why:
        return result("skipped", str(why))
    except Missed as why:
        return result("miss", str(why))
    except TimeoutError:
        cut = "" if limit_s == row.limit_s else ", which was all that was left: see --within"
        return result("failed", f"no result within {limit_s:.0f} s{cut}")
    except Exception as error:  # noqa: BLE001  a defect of one row is a result, too
        return result("failed", f"{type(error).__name__}: {error}")
