"""What the arbiter will do next for a waiter, and at which instant where that is planned. Reads only; for people who ask `why`.

A step is `{"action", "consumer", "lease_id", "in_s", "text"}`; `in_s` None: it depends on somebody, no instant is planned.
Not on the path of a decision: looking ahead costs a search for victims per instant.
"""

from typing import Any

from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report.standing import Standing
from vram_arbiter.arbiter.core.scheduling import policy

LOOKED_AT_MAX = 16
"""Instants at which somebody could be asked that are looked at, the nearest first."""
LOOKS_AT_HOLDERS_MAX = 400
"""Beside many holders fewer instants are looked at: each look weighs all of them."""

type Step = dict[str, Any]


def steps(core: Core, standing: Standing, waiter: Lease) -> list[Step]:
    """For a queued lease, the nearest first; what has no instant comes last."""
    gpu = standing.gpu
    if not any(waiter in core.gpus[gpu_id].queue for gpu_id in waiter.request.gpus):
        found = _of_unqueued(core, gpu, standing, waiter)
    else:
        first = policy.front(core, gpu)
        mine = any(first is one for one in standing.fellows)
        found = _of_head(core, gpu, standing.request) if mine else []
    if waiter.request.wait_timeout_s is not None:
        at = waiter.request.arrived_at + waiter.request.wait_timeout_s
        found.append(
            _step(core, "give_up", waiter, at, "gives up", "when its wait timeout is over")
        )
    return sorted(found, key=lambda step: float("inf") if step["in_s"] is None else step["in_s"])


def _of_unqueued(core: Core, gpu: Gpu, standing: Standing, waiter: Lease) -> list[Step]:
    """Of a request that waits for the rest of its group, or with its bytes reserved for its turn to load."""
    found: list[Step] = []
    if waiter.id in gpu.ledger.reserved:
        found = [_load_ends(core, lease) for lease in gpu.in_state(LeaseState.LOADING)]
        found = found or [
            _next_reading(core, gpu, "its bytes are kept for it, the card has to show them")
        ]
    if standing.gives_up is not None:
        at, because = standing.gives_up
        found.append(_step(core, "break", None, at, f"gives {standing.group} up", because))
    return found


def _load_ends(core: Core, lease: Lease) -> Step:
    what = f"lets {lease.spec.consumer} finish loading"
    return _step(core, "loaded", lease, _learnt_end(core, lease), what, "one loads at a time")


def _of_head(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    if core.recovering is not None:
        ends = [core.leases[lease].expires_at for lease in core.recovering if lease in core.leases]
        at = max(ends, default=None)
        return [
            _step(
                core,
                "serve",
                None,
                at,
                "grants again",
                "when every holder has come back or its time is over",
            )
        ]
    if gpu.failed_at is not None or gpu.sample is None:
        return [_next_reading(core, gpu, "nothing is granted on a card that cannot be read")]
    found = [_load_ends(core, lease) for lease in gpu.in_state(LeaseState.LOADING)]
    found += [_leaving(core, gpu, waiter, lease) for lease in gpu.in_state(*LEAVING)]
    going = policy.leaving(gpu)
    if found or policy.blocked(core, gpu):
        return found
    if policy.fits(gpu, waiter, going):
        return [_next_reading(core, gpu, "the ledger has room, the card has to show it")]
    return _asking(core, gpu, waiter)


def _asking(core: Core, gpu: Gpu, waiter: Lease) -> list[Step]:
    """Whom it will ask, and when: at the first instant at which somebody may be asked whose leaving is enough."""
    going = policy.leaving(gpu)
    looks = max(1, min(LOOKED_AT_MAX, LOOKS_AT_HOLDERS_MAX // (1 + len(gpu.residents))))
    for at in sorted({core.now, *policy.ask_times(core, gpu, waiter)})[:looks]:
        victims = policy.choose_victims(core, gpu, waiter, going, at)
        if victims is None:
            continue
        return [
            _step(
                core,
                "ask",
                victim,
                at,
                f"asks {victim.spec.consumer}",
                _because(core, waiter, victim, at),
            )
            for victim in victims
        ]
    if missing := [lease for lease in gpu.in_state(LeaseState.HELD) if not lease.attached]:
        last = max(missing, key=lambda lease: lease.expires_at)
        what, because = f"gives {last.spec.consumer} up", "unless it comes back before that"
        return [_step(core, "wait", last, last.expires_at, what, because)]
    return [
        _step(
            core,
            "wait",
            None,
            None,
            "asks nobody",
            "those who could make room are pinned or in use above its priority",
        )
    ]


def _because(core: Core, waiter: Lease, victim: Lease, at: float) -> str:
    if at <= core.now:
        return "as soon as the card is looked at again"
    if at == policy.residency_ends_at(core, victim, waiter):
        return "when its minimum residency ends"
    return (
        "when the waiter's priority has aged to its own"
        if victim.in_use
        else "when enough may be asked together"
    )


def _leaving(core: Core, gpu: Gpu, waiter: Lease, holder: Lease) -> Step:
    name = holder.spec.consumer
    verification = gpu.verifications.get(holder.id)
    if verification is not None:
        latest = max(0.0, verification.deadline_at - core.now)
        because = (
            f"a verdict comes in {latest:.1f} s at the latest"
            if latest
            else "until its bytes are measured gone"
        )
        return _step(
            core,
            "measure",
            holder,
            verification.next_poll_at,
            f"measures {name}'s bytes again",
            because,
        )
    eviction = holder.departure.eviction
    if eviction is None or eviction.overdue:
        because = "its unloading may hang" if holder.departure.hangs else "it is on its way out"
        return _step(core, "wait", holder, None, f"waits for {name} to let go", because)
    at = (
        holder.since if holder.state is LeaseState.UNLOADING else eviction.asked_at
    ) + core.settings.revoke_deadline_s
    then = (
        "is denied"
        if waiter.spec.deny_on_deadline
        else "waits on, and the holder's own rule applies"
    )
    return _step(
        core,
        "deadline",
        holder,
        at,
        f"waits for {name} to let go",
        f"after that {waiter.spec.consumer} {then}",
    )


def _next_reading(core: Core, gpu: Gpu, because: str) -> Step:
    times = [core.timers.due((kind, gpu.info.id)) for kind in ("verify", "probe")]
    at = min((time for time in times if time is not None), default=None)
    return _step(core, "read", None, at, "reads the card again", because)


def _learnt_end(core: Core, lease: Lease) -> float | None:
    end = lease.granted_at + (core.learnt_s(lease.spec.consumer, "load_s") or 0.0)
    return end if end > core.now else None


def _step(
    core: Core, action: str, lease: Lease | None, at: float | None, what: str, because: str
) -> Step:
    in_s = None if at is None else max(0.0, at - core.now)
    when = (
        ""
        if in_s is None
        else f" for {in_s:.1f} s more"
        if action == "deadline"
        else f" in {in_s:.1f} s"
    )
    return {
        "action": action,
        "consumer": "" if lease is None else lease.spec.consumer,
        "lease_id": None if lease is None else lease.id,
        "in_s": in_s,
        "text": f"{what}{when}, {because}",
    }
