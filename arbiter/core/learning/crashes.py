"""Models that die in their load, again and again, do not throw others out for every try.

A supervisor starts a program again at once, and each start would empty the card for a load that
fails. After a few failures in a row an acquire that needs an eviction is refused for a while, twice
as long after each, with the cause of the last one. What fits as the card is costs nothing and is
granted as ever. One load that succeeds forgets it all; so does a restart.
"""

from typing import Final

from vram_arbiter.arbiter.core.events import LeaseSpec
from vram_arbiter.arbiter.core.learning.drift import model_name
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import Failures, Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import GpuId

FREE: Final = 2
"""So many failures in a row cost nothing: the first may be an accident, the second the same one."""
PAUSE_S: Final = 2.0
PAUSE_MAX_S: Final = 60.0
FORGOTTEN_S: Final = 600.0
NAMES_MAX: Final = 256


def failed(core: Core, lease: Lease, cause: str) -> None:
    """A lease is over without its holder's word. Nothing, unless it was loading."""
    if lease.state is not LeaseState.LOADING:
        return
    name = model_name(lease.spec)
    before = core.crashes.pop(name, None)
    if before is None or core.now - before.last_at > FORGOTTEN_S:
        before = Failures(0, core.now, "")
    core.crashes[name] = Failures(before.count + 1, core.now, cause)
    if len(core.crashes) > NAMES_MAX:
        del core.crashes[next(iter(core.crashes))]  # the one that failed longest ago


def succeeded(core: Core, lease: Lease) -> None:
    core.crashes.pop(model_name(lease.spec), None)


def check(core: Core, spec: LeaseSpec, load_peak_bytes: int, gpus: tuple[GpuId, ...]) -> None:
    """Refuse an acquire that would need an eviction for one more try. Raises Refused."""
    seen = core.crashes.get(model_name(spec))
    if seen is None or (wait_s := seen.last_at + _pause_s(seen) - core.now) <= 0:
        return
    if any(_costs_nobody(core.gpus[gpu], spec, load_peak_bytes) for gpu in gpus):
        return
    raise Refused(no.LoadFails(spec.consumer, str(spec.key), seen.count, seen.cause, wait_s))


def _pause_s(seen: Failures) -> float:
    return min(PAUSE_MAX_S, PAUSE_S * 2.0 ** (seen.count - FREE - 1)) if seen.count > FREE else 0.0


def _costs_nobody(gpu: Gpu, spec: LeaseSpec, load_peak_bytes: int) -> bool:
    free = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
    return (
        gpu.queue.head() is None
        and not (spec.exclusive and gpu.residents)
        and load_peak_bytes <= free
    )
