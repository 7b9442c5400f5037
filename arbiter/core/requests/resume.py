"""Resume of the machine from suspend, such as a laptop's lid.

The monotonic clock stood still, so no TTL ran out. Readings from before do not count: drivers may
have moved or dropped memory, and holders wake up in any order. Every holder gets its full TTL,
every GPU is unknown until it is read, and verifications begin again.
"""

from vram_arbiter.arbiter.core.events import Resumed
from vram_arbiter.arbiter.core.model.lease import EXPIRING
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.requests.recovery import EMPTY_JOURNAL, await_unnamed
from vram_arbiter.arbiter.core.requests.uses import await_users
from vram_arbiter.arbiter.core.verification import schedule


def on_resumed(core: Core, event: Resumed) -> None:
    """No reading that began before counts from here on."""
    core.note("resumed", slept_s=event.slept_s)
    grace_s = core.settings.fence_grace_s
    for lease in core.leases.values():
        if lease.state in EXPIRING:
            lease.expires_at = core.now + lease.spec.ttl_s + (0.0 if lease.attached else grace_s)
            core.timers.set(("ttl", lease.id), lease.expires_at)
        if ("users", lease.id) in core.timers:
            await_users(core, lease)
    if ("recover", EMPTY_JOURNAL) in core.timers:
        await_unnamed(core)
    for gpu in core.gpus.values():
        _measure_anew(core, gpu)


def _measure_anew(core: Core, gpu: Gpu) -> None:
    gpu.before_sleep = gpu.sample or gpu.before_sleep
    gpu.sample = None
    gpu.read_from = core.now
    core.want_sample(gpu, core.now)
    schedule.begin_again(core, gpu)
    core.wake(gpu)
