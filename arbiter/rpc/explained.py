"""Answers to `why`, and blocked GPUs, in words."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.wire.codes import Block, RevokeCause, Wait
from vram_arbiter.schemas.wire.explained import (
    Because,
    Blocker,
    Condition,
    Explanation,
    NextAction,
    Return,
    Situation,
    Step,
)
from vram_arbiter.schemas.wire.views import BlockView, GpuView

WAIT: Final[Mapping[Wait, str]] = {
    Wait.MAKING_ROOM: "room is being made",
    Wait.READING: "waits for a fresh reading of the GPU",
    Wait.NOT_FREE: "the ledger has room, the GPU does not: measured memory is not free yet",
    Wait.RESIDUE: "a dead process's memory is being measured",
    Wait.NO_VICTIM: "no holder that could make room may be revoked now",
}


def worded(told: Explanation) -> Explanation:
    """Return an explanation with its words."""
    blockers = tuple(replace(one, text=condition(one)) for one in told.blockers)
    plan = tuple(replace(step, text=step_words(step)) for step in told.plan)
    told = replace(told, blockers=blockers, plan=plan)
    then = _resident(told) if told.state != "queued" else _waiter(told)
    head = told.consumer if told.state != "queued" else _needs(told)
    return replace(told, next=then, text=f"{head}: {then}")


def worded_gpu(gpu: GpuView) -> GpuView:
    """Return a GPU's view with the words of its block."""
    if gpu.blocked is None:
        return gpu
    return replace(gpu, blocked=replace(gpu.blocked, text=block(gpu.blocked)))


def block(why: BlockView) -> str:
    """Why nothing is granted on a GPU."""
    names = ", ".join(why.names) + (f" and {why.more} more" if why.more else "")
    if why.code is Block.RECOVERING and not names:
        names = "holders that the journal may not name"
    return _BLOCKS[why.code].format(why=why, names=names, size=gib(why.bytes or 0))


_BLOCKS: Final[Mapping[Block, str]] = {
    Block.RECOVERING: "recovering after a restart: {names} must reattach first",
    Block.DRAINED: "drained by {why.problem}",
    Block.UNREADABLE: "the GPU cannot be read: {why.problem}",
    Block.UNREAD: "the GPU has not been read yet",
    Block.LOADING: "{names} is loading",
    Block.PRESSURE: "pressure: {size} more than the budget are held",
    Block.NOT_FREE: WAIT[Wait.NOT_FREE],
}


def wait_for(why: BlockView | None) -> str:
    """What a request waits for that is the first of its queue and was not looked at yet."""
    return "waits for its turn" if why is None else f"waits: {block(why)}"


# -- waiters
def _needs(told: Explanation) -> str:
    head = f"{told.consumer} needs {gib(told.needed_bytes)}, {gib(told.free_bytes)} are free"
    head += f", {gib(told.deficit_bytes)} are missing" if told.deficit_bytes else ""
    if told.expected_bytes is not None:
        declared = told.footprint.declared_bytes["load_peak"]
        head += f" ({gib(declared)} declared, {gib(told.expected_bytes)} learned)"
    return head


def _waiter(told: Explanation) -> str:
    match told.condition:
        case Situation.BEHIND:
            return f"waits behind {told.ahead} as number {told.position}"
        case Situation.MAKING_ROOM:
            return "; ".join(map(_leaving, told.leaving))
        case Situation.BLOCKED if told.block is not None:
            loads = [one for one in told.blockers if one.condition is Condition.LOADING]
            if told.block.code is Block.LOADING and loads:
                return f"waits: {loads[0].consumer} {condition(loads[0])}"
            return f"waits: {block(told.block)}"
        case Situation.NO_ROOM:
            names = ", ".join(f"{one.consumer} ({one.text})" for one in told.blockers)
            return f"waits for {names}"
    if told.measuring:
        return f"waits until the bytes of {', '.join(told.measuring)} are measured gone"
    return WAIT[told.wait or Wait.READING]


def _leaving(one: Blocker) -> str:
    charge, ago = gib(one.bytes), f"revoked {one.seconds or 0.0:.1f} s ago"
    match one.condition:
        case Condition.REVOKED if one.uses:
            return (
                f"waits for {one.consumer} to finish {_in_flight(one)} ({ago}), then it unloads "
                f"and {charge} are verified"
            )
        case Condition.REVOKED:
            return f"waits for {one.consumer} to unload ({ago}), then {charge} are verified"
        case Condition.UNLOADING:
            return f"{one.consumer} unloads, then {charge} are verified"
        case Condition.HANGING:
            return f"{one.consumer} {condition(one)}, then {charge} are verified"
        case _:
            return f"{charge} of {one.consumer} are being verified"


def condition(one: Blocker) -> str:
    """The condition on which a blocker's bytes come free."""
    match one.condition:
        case Condition.LOADING:
            return _loading(one)
        case Condition.REVOKED:
            return f"was revoked {one.seconds or 0.0:.1f} s ago, {_uses(one)}"
        case Condition.PINNED if one.by:
            return f"is pinned by {one.by}"
        case _:
            return _CONDITIONS[one.condition].format(one=one, seconds=one.seconds or 0.0)


_CONDITIONS: Final[Mapping[Condition, str]] = {
    Condition.UNLOADING: "is unloading",
    Condition.HANGING: "is unloading for {seconds:.0f} s and may hang: end its process (pid "
    "{one.pid})",
    Condition.MEASURED: "released, its bytes are being measured",
    Condition.NOT_BACK: "has not reattached since the restart, is given up in {seconds:.1f} s",
    Condition.PINNED: "is pinned",
    Condition.RESIDENCY: "may stay {seconds:.1f} s more (minimum residency)",
    Condition.THRASHING: "may stay {seconds:.1f} s more (they keep evicting each other)",
    Condition.PRIORITY: "is in use and has priority {one.priority}, the waiter "
    "{one.waiter_priority}",
    Condition.IN_USE: "is in use for {seconds:.0f} s",
    Condition.IDLE: "is idle and may be revoked",
    Condition.CONTEXT: "keeps its context until it exits",
    Condition.RETAINED: "keeps more than its context until its process (pid {one.pid}) gives it "
    "back or ends",
    Condition.DEBT: "is over, its bytes are being measured",
    Condition.DEBT_KEPT: "is over, and its process (pid {one.pid}) keeps its bytes until it frees "
    "them or ends",
    Condition.STOWAWAY: "holds bytes without a lease",
}


def _loading(one: Blocker) -> str:
    if one.loaded_bytes is None:
        return "is loading"
    told = f"is loading for {one.seconds or 0.0:.0f} s, {gib(one.loaded_bytes)} so far"
    return told if one.quiet_s is None else f"{told}, nothing new for {one.quiet_s:.0f} s"


def _in_flight(one: Blocker) -> str:
    label = f' "{printable(one.label)}"' if one.label else ""
    return f"1 use{label}" if one.uses == 1 else f"{one.uses} uses"


def _uses(one: Blocker) -> str:
    return f"{_in_flight(one)} running" if one.uses else "idle"


# -- leases that are granted
def _resident(told: Explanation) -> str:
    says = _away(told) if told.holder is None else _holder(told, told.holder)
    if told.drifted:
        held, declared = told.footprint.held_bytes or 0, told.footprint.declared_bytes["steady"]
        says += f"; it holds {gib(held)}, {gib(declared)} were declared"
    return says


def _holder(told: Explanation, holder: Blocker) -> str:
    match told.state:
        case "loading":
            return f"it was granted and {_loading(holder)}"
        case "revoking":
            return f"it was revoked for {_wanted_by(told.revoked)}, {_uses(holder)}"
        case "unloading":
            return f"it {condition(holder)}"
        case "verifying":
            return "it released; its bytes are being measured"
        case _:
            return f"it is resident, {_uses(holder)}"


def _wanted_by(why: RevokeCause | None) -> str:
    if why is None or why.cause == "pressure":
        return "relief of pressure"
    return why.wanted_by or "an operator"


def _away(told: Explanation) -> str:
    where = "parked" if told.state == "parked" else "on standby"
    match told.back:
        case Return.HOLDER:
            return f"{where}, but its holder did not reattach after the restart"
        case Return.ASKED:
            return f"{where} in host RAM until its holder asks for it"
        case Return.BEHIND:
            return f"{where}: {told.ahead} waits, and goes first"
        case Return.BLOCKED if told.block is not None:
            return f"{where}: {block(told.block)}"
        case Return.LEFT_FOR:
            return f"{where} until {told.ahead} has left"
        case Return.NO_ROOM:
            return f"{where} until there is room; it revokes no holder"
        case Return.QUIET:
            return f"{where}: comes back in {told.due_s or 0.0:.1f} s if the GPU stays quiet"
        case _:
            return f"{where}: returns with the next reading of the GPU, or after those before it"


# -- steps
def step_words(step: Step) -> str:
    """What happens next, when, and why then."""
    when = ""
    if step.in_s is not None:
        more = step.action is NextAction.DEADLINE
        when = f" {step.in_s:.1f} s more" if more else f" in {step.in_s:.1f} s"
    action = _ACTIONS[step.action]
    if step.action is NextAction.WAIT:
        action = _WAITS.get(step.because, action)
    text = f"{action}, {_BECAUSE[step.because]}"
    return text.format(step=step, when=when, latest_s=step.latest_s or 0.0)


_ACTIONS: Final[Mapping[NextAction, str]] = {
    NextAction.ASK: "revokes {step.consumer}{when}",
    NextAction.LOADED: "lets {step.consumer} finish loading{when}",
    NextAction.READ: "reads the GPU again{when}",
    NextAction.MEASURE: "measures {step.consumer}'s bytes again{when}",
    NextAction.DEADLINE: "waits{when} for {step.consumer} to release",
    NextAction.WAIT: "waits for {step.consumer} to release{when}",
    NextAction.SERVE: "grants again{when}",
    NextAction.GIVE_UP: "gives up{when}",
}

_WAITS: Final[Mapping[Because, str]] = {
    Because.NO_VICTIM: "revokes no holder{when}",
    Because.NOT_BACK: "gives up {step.consumer}{when}",
}

_BECAUSE: Final[Mapping[Because, str]] = {
    Because.NEXT_READING: "with the next reading of the GPU",
    Because.RESIDENCY: "when its minimum residency ends",
    Because.AGEING: "when the waiter's priority has aged to its own",
    Because.TOGETHER: "when enough may be revoked together",
    Because.ONE_LOAD: "only one model loads at a time",
    Because.UNREADABLE: "nothing is granted on a GPU that cannot be read",
    Because.MEASUREMENT: "the ledger has room, but the GPU has to show it",
    Because.ACCOUNTED: "when every holder has reattached or its time is over",
    Because.NOT_BACK: "unless it reattaches before that",
    Because.NO_VICTIM: "those that could make room are pinned or in use above its priority",
    Because.VERDICT: "a verdict comes in {latest_s:.1f} s at the latest",
    Because.MEASURED_GONE: "until its bytes are measured gone",
    Because.HANGING: "its unloading may hang",
    Because.LEAVING: "it is being evicted",
    Because.WAITS_ON: "after that {step.waiter} waits on",
    Because.TIMEOUT: "when its wait timeout is over",
}


def gib(count: int) -> str:
    """Bytes as `1.25 GiB`."""
    return f"{count / 2**30:.2f} GiB"
