"""Requests for bytes that are refused at once, as notes: history and log say of each why nothing
came of it.

A process that asks and is refused thousands of times a second must not push everything else out of
the history: beyond a number at once its refusals are counted, and the next note says how many were
left out.
"""

from vram_arbiter.arbiter.core.events import AcquireRequested, Reacquired, ResizeAsked
from vram_arbiter.arbiter.core.model.state import Core, Refusals
from vram_arbiter.schemas.wire.errors import Refusal

AT_ONCE = 16
"""Refusals of one process that are noted one by one; after that one a second."""
PROCESSES_REMEMBERED = 1024


def note(core: Core, event: AcquireRequested | Reacquired | ResizeAsked, refusal: Refusal) -> None:
    """Note that a request was refused, its client and why."""
    client = core.clients.get(event.client)
    if client is None:
        return  # it has not said hello
    seen = core.refusals.pop(client.process, None) or Refusals(core.now)
    core.refusals[client.process] = seen
    while len(core.refusals) > PROCESSES_REMEMBERED:
        del core.refusals[next(iter(core.refusals))]
    seen.noted = max(0.0, seen.noted - (core.now - seen.at))
    seen.at = core.now
    if seen.noted > AT_ONCE - 1:
        seen.left_out += 1
        return
    seen.noted += 1
    lease = None if isinstance(event, AcquireRequested) else core.leases.get(event.lease)
    who = {"consumer": event.spec.consumer} if isinstance(event, AcquireRequested) else {}
    left_out = {"left_out": seen.left_out} if seen.left_out else {}
    seen.left_out = 0
    core.note(
        "refused",
        lease,
        **who,
        pid=client.process.pid,
        code=refusal.code,
        refusal=refusal,
        **left_out,
    )
