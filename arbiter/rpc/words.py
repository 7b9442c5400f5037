"""English for plain wire clients, history and logs: the engine's codes and values in words.

The engine holds no prose, so that rewording a message changes no decision and no replay. Each error
says what is wrong, with values, then what to do. `arbiter.rpc.explained` does the same for answers
to `why`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final, Literal

from vram_arbiter.arbiter.core.model import refusals as r
from vram_arbiter.arbiter.rpc import explained
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.wire.codes import RevokeCause, Why
from vram_arbiter.schemas.wire.errors import ErrorView, Refusal
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.pushes import AnyPush, DeniedPush, LostPush, RevokePush
from vram_arbiter.schemas.wire.replies import AnyReply, ReattachReply, RenewReply, StatusReply

WHY: Final[Mapping[Why, str]] = {
    Why.HOLDER_GAVE_UP: "its holder gave up",
    Why.CLIENT_LEFT: "its client left",
    Why.PROCESS_DIED: "its process died",
    Why.NOT_RENEWED: "it was not renewed",
    Why.GIVEN_UP: "it was given up by an operator",
    Why.EVICTED: "evicted by an operator",
    Why.NOT_BACK: "its holder did not come back after the restart",
    Why.NOT_HELD: "it is no longer held",
    Why.UNKNOWN: "it is not known",
    Why.OVER: "the lease is over",
    Why.ENDED: "ended",
    Why.PAUSED: "unloaded while it paused",
    Why.USER_NOT_BACK: "its process did not come back to it after the restart",
    Why.LET_GO: "released by its holder",
    Why.LET_GO_BEFORE: "released before the restart, says its holder",
    Why.EXITS: "its process exits",
    Why.BYE: "its client said bye",
    Why.LEAVES: "the lease is unloaded",
    Why.RESIZED: "another size is asked for",
}

_ACQUIRE = "unload, then acquire again"
_UNPIN = "unpin it first"
_PINNED = "end its program: a pinned holder is never made to leave"


# -- errors
def error_view(refusal: Refusal) -> ErrorView:
    """Return the error of a refusal with its words: what is wrong, then what to do."""
    if isinstance(refusal, r.TimedOut):
        refusal = replace(refusal, why=explained.worded(refusal.why))
    if isinstance(refusal, r.TargetOver):
        ended = error_view(refusal.ended)
        return replace(ended, hint="it is over; its story is in `vramctl history`")
    message, hint = _ERRORS[type(refusal)](refusal)
    return ErrorView(refusal.code, message, hint, to_map(refusal))


def _unknown_gpu(no: r.UnknownGpu) -> tuple[str, str]:
    return f"there is no GPU {no.gpu!r}", "give a UUID, an index or `any`"


def _too_large(no: r.TooLarge) -> tuple[str, str]:
    raised = no.needed_bytes > no.declared_bytes
    learned = f" ({no.declared_bytes} declared, more was measured)" if raised else ""
    return (
        f"{no.consumer} needs {no.needed_bytes} bytes{learned}; the GPU has {no.capacity_bytes} "
        f"less a reserve of {no.reserve_bytes}",
        "use a smaller model or a lower precision",
    )


def _growth_too_large(no: r.GrowthTooLarge) -> tuple[str, str]:
    told = (
        f"{no.consumer} would need {no.needed_bytes} bytes; alone on its GPU it can have "
        f"{no.room_bytes}"
    )
    return told, "stay smaller"


def _bad_lease_state(no: r.BadLeaseState) -> tuple[str, str]:
    told = {
        r.Misfit.STILL_QUEUED: "it is still queued",
        r.Misfit.NOT_AWAY: "only a lease that is away, or being measured on its way there, is "
        "called back",
        r.Misfit.GRANTED: "it is granted already, release it",
        r.Misfit.NOT_LOADING: "only a loading lease becomes ready",
        r.Misfit.NOT_HELD: "only a held lease can be used",
        r.Misfit.NOT_UNLOADABLE: "only a held lease is unloaded; a loading one is released",
        r.Misfit.NOT_RESIZABLE: "only a held lease is resized",
        r.Misfit.IN_USE: f"{no.uses} uses still run; wait for the `revoke` that says 0 uses",
        r.Misfit.EXITS: "it cannot be parked: a process that exits keeps nothing",
        r.Misfit.NO_PARK_BYTES: "it cannot be parked: its spec has no park_bytes",
        r.Misfit.HOLDS_NOTHING: "it holds nothing",
        r.Misfit.NO_SUCH_USE: f"it has no use {no.use_id} of yours to yield",
    }[no.misfit]
    return f"{no.lease_id} is {no.state}: {told}", "see the lease's story"


def _bad_target_state(no: r.BadTargetState) -> tuple[str, str]:
    lease, is_in = no.lease_id, f"{no.lease_id} is {no.state}"
    look = "see `vramctl status`"
    undo = "nothing to undo"
    if not no.evictable:
        undo = "its holder asked never to be evicted; that is its own to change"
    heard = f"the holder of {lease} was heard of {no.silent_s or 0.0:.1f} s ago: it is not dead"
    instead = "evict it instead" if no.evictable else "end its program: it is pinned"
    return {
        r.Impractical.NOT_RESIDENT: (f"{is_in}: only a resident lease can be evicted", look),
        r.Impractical.LEAVING: (f"{is_in}: it was asked to leave already", look),
        r.Impractical.NOT_HELD: (f"{is_in}: it has no holder", look),
        r.Impractical.IN_USE: (f"{is_in}: it is in use; a holder in use is never given up", look),
        r.Impractical.PINNED_BY_OPERATOR: (f"{lease} is pinned: an operator pinned it", _UNPIN),
        r.Impractical.PINNED_BY_HOLDER: (
            f"{lease} is pinned: its holder asked never to be evicted",
            _PINNED,
        ),
        r.Impractical.NOT_PINNED: (f"no operator pinned {lease}", undo),
        r.Impractical.HOLDER_LIVES: (heard, instead),
    }[no.problem]


def _lease_over(no: r.LeaseOver) -> tuple[str, str]:
    told = "" if no.revoked is None else f": {cause(no.revoked)}"
    return f"{no.lease_id} is {no.state}{told}", _ACQUIRE


def _revoked(no: r.Revoked) -> tuple[str, str]:
    told = "" if no.revoked is None else f": {cause(no.revoked)}"
    hint = {
        "use": "wait until it is granted again",
        "resize": "leave; ask for the new size when it is granted again",
    }[no.wanted]
    return f"{no.consumer} was asked to leave{told}", hint


def _limit(no: r.LimitReached) -> tuple[str, str]:
    what, hint = {
        "waiters_max": (
            "requests wait",
            "let some of them be answered first, or raise limits.waiters_max",
        ),
        "leases_per_client_max": (
            "leases are held or asked for",
            "release some, or raise limits.leases_per_client_max",
        ),
        "uses_per_lease_max": (
            f"uses of {no.lease_id} run or pause",
            "end some, or raise limits.uses_per_lease_max",
        ),
    }[no.limit]
    whose = {
        r.Share.CONNECTION: "by this connection",
        r.Share.PROCESS: "of this process",
        r.Share.USER: f"of uid {no.uid}",
        r.Share.ALL: "of all users",
        r.Share.HOLDER: "of its holder",
        r.Share.OTHERS: "of others than its holder",
    }[no.share]
    return f"{no.count} {what} {whose}, the limit is {no.value}", hint


def _load_fails(no: r.LoadFails) -> tuple[str, str]:
    return (
        f"{no.consumer} failed {no.failures} times in a row to load {no.model}: {_why(no.cause)}",
        f"no holder is made to leave for it for {no.retry_in_s:.0f} s more; look at its own log",
    )


def _ambiguous(no: r.Ambiguous) -> tuple[str, str]:
    names = ", ".join(no.leases)
    return f"{no.target} has {len(no.leases)} leases", f"name one of them: {names}"


def _no_host_ram(no: r.NoHostRam) -> tuple[str, str]:
    return (
        f"{no.needed_bytes} bytes of host RAM are asked for; of a budget of {no.budget_bytes} "
        f"{no.booked_bytes} are booked",
        "release without parking, or raise host.park_budget_bytes",
    )


def _timed_out(no: r.TimedOut) -> tuple[str, str]:
    told = f"{no.consumer} waited {no.waited_s:.1f} s: {no.why.text}"
    return told, "wait longer, or make room"


def _expired(no: r.Expired) -> tuple[str, str]:
    told = f"was not renewed for {no.ttl_s:g} s"
    if no.why is Why.GIVEN_UP:
        told = f"was given up by {no.order}"
    return f"{no.lease_id} {told}", _ACQUIRE


def _lost(no: r.Lost) -> tuple[str, str]:
    match no.why:
        case Why.PROCESS_DIED:
            return f"{no.lease_id}: process {no.pid} died", "acquire again"
        case Why.EVICTED:
            return f"{no.lease_id}: evicted by {no.order}", "acquire again"
        case Why.NOT_HELD:
            return f"{no.lease_id} is no longer held", _ACQUIRE
        case Why.UNKNOWN:
            return f"{no.lease_id} is not known", _ACQUIRE
        case _:
            return f"{no.lease_id}: {_why(no.why)}", "acquire again"


def _mismatch(no: r.GangMismatch) -> tuple[str, str]:
    if no.size != no.asked:
        return f"gang {no.gang} has {no.size} members, not {no.asked}", "agree on one size"
    told = f"all {no.size} members of gang {no.gang} have come"
    return told, "use an id of its own for each gang"


def _gang_too_large(no: r.GangTooLarge) -> tuple[str, str]:
    told = (
        f"gang {no.gang}: its {no.members} members need {no.needed_bytes} bytes together, "
        "more than the GPUs can ever hold"
    )
    return told, "ask for all of it again"


def _broken_gang(no: r.BrokenGang) -> tuple[str, str]:
    because = f" ({no.because})" if no.because else ""
    told = {
        r.GangEnd.REFUSED: f"a member was refused{because}",
        r.GangEnd.FALLEN: f"{no.consumer} ({no.lease_id}) is {no.state}{because}",
        r.GangEnd.INCOMPLETE: "not all of it came back after the restart",
        r.GangEnd.MEMBER_TOO_LARGE: "a member holds more than it declared, the rest no longer fits",
        r.GangEnd.OTHERS_TOO_LARGE: "others hold more than they were granted, the rest no longer "
        "fits",
        r.GangEnd.NOT_FREED: "measured memory did not come back, the rest no longer fits",
    }[no.why]
    return f"gang {no.gang}: {told}", "ask for all of it again"


def _deadlock(no: r.Deadlock) -> tuple[str, str]:
    def names(leases: tuple[r.NamedLease, ...]) -> str:
        return " and ".join(f"{one.consumer} ({one.lease_id})" for one in leases)

    def told(link: r.CycleLink) -> str:
        uses = f"uses {names(link.holds)} and " if link.holds else ""
        return f"{link.consumer} (pid {link.pid}) {uses}waits for {names(link.waits_for)}"

    story = "; ".join(map(told, no.cycle))
    hint = "`yield` the use, release first, or mark the wait `independent`"
    return f"this wait would never end: {story}", hint


_ERRORS: Final[Mapping[type[Refusal], Callable[[Any], tuple[str, str]]]] = {
    r.NoSession: lambda no: ("this connection has not said hello", "say hello, then re-attach"),
    r.NoLease: lambda no: (f"there is no lease {no.lease_id}",
    "acquire one; after a restart: re-attach"),
    r.WrongToken: lambda no: (f"{no.token} is not the token of {no.lease_id}",
    "use the token that came with the grant"),
    r.NotHolder: lambda no: (f"{no.lease_id} belongs to process {no.pid}", "ask as its holder"),
    r.BadLeaseState: _bad_lease_state,
    r.BadTargetState: _bad_target_state,
    r.Ambiguous: _ambiguous,
    r.NoTarget: lambda no: (f"there is no lease or consumer {no.target!r}", "see `vramctl status`"),
    r.LeaseOver: _lease_over,
    r.Revoked: _revoked,
    r.UnknownGpu: _unknown_gpu,
    r.TooLarge: _too_large,
    r.GrowthTooLarge: _growth_too_large,
    r.NoHostRam: _no_host_ram,
    r.LimitReached: _limit,
    r.LoadFails: _load_fails,
    r.CancelledRequest: lambda no: (f"{no.lease_id}: {_why(no.why, no.by)}", "acquire again"),
    r.TimedOut: _timed_out,
    r.HolderOutstays: lambda no: (
        f"{no.consumer} did not leave within {no.deadline_s:g} s",
        "try again later, or wait: on_deadline=wait"
    ),
    r.Expired: _expired,
    r.Lost: _lost,
    r.NotJournaled: lambda no: (
        f"the grant of {no.lease_id} could not be written: {no.problem}",
        "look at the daemon's log and its disk"
    ),
    r.GangMismatch: _mismatch,
    r.GangTooLarge: _gang_too_large,
    r.BrokenGang: _broken_gang,
    r.Deadlock: _deadlock,
}  # fmt: skip


def _worded(error: ErrorView) -> ErrorView:
    return error_view(error.details) if isinstance(error.details, Refusal) else error


# -- replies and pushes
def reply(body: AnyReply) -> AnyReply:
    """Return a reply with its words."""
    match body:
        case RenewReply(gone=gone) if gone:
            return replace(body, gone=tuple(replace(one, error=_worded(one.error)) for one in gone))
        case ReattachReply(leases=leases):
            return ReattachReply(
                tuple(
                    one if one.error is None else replace(one, error=_worded(one.error))
                    for one in leases
                )
            )
        case StatusReply(gpus=gpus):
            return replace(body, gpus=tuple(map(explained.worded_gpu, gpus)))
        case WhyReply(leases=leases):
            return replace(body, leases=tuple(map(explained.worded, leases)))
        case _:
            return body


def push(body: AnyPush) -> AnyPush:
    """Return a push with its words."""
    match body:
        case DeniedPush(error=error) | LostPush(error=error):
            return replace(body, error=_worded(error))
        case RevokePush():
            why = RevokeCause(_cause(body.cause), body.wanted_by, body.gang, body.order)
            return replace(body, reason=cause(why))
        case _:
            return body


def _cause(code: str) -> Literal["waiter", "pressure", "operator"]:
    return "operator" if code == "operator" else "pressure" if code == "pressure" else "waiter"


def cause(why: RevokeCause) -> str:
    """Why a holder is revoked."""
    if why.order is not None:
        return f"evicted by {why.order}"
    if why.cause == "pressure":
        return "the GPU holds more than its budget"
    who = f"gang {why.gang}" if why.gang else why.wanted_by
    return f"{who} needs the room"


def _why(code: str, by: str = "") -> str:
    words = WHY.get(code, code)  # type: ignore[call-overload]
    return f"{words}: {by}" if by else str(words)


# -- events
def event(kind: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts of a note as history keeps them: plain values, and `reason` in words."""
    plain = {key: _plain(value) for key, value in data.items() if key != "refusal"}
    refusal = data.get("refusal")
    reason = error_view(refusal).message if isinstance(refusal, Refusal) else _reason(kind, data)
    if reason and "reason" not in plain:
        plain["reason"] = reason
    return plain


def _plain(value: Any) -> Any:
    return to_map(value) if hasattr(value, "__dataclass_fields__") else value


def _reason(kind: str, data: Mapping[str, Any]) -> str:
    if (make := _REASONS.get(kind)) is not None:
        return make(data)
    why = data.get("why")
    return _why(why, data.get("by", "")) if why else ""


def _granted(data: Mapping[str, Any]) -> str:
    if data.get("by_itself"):
        return "back from standby: there is room and nothing waits"
    if evicted := data["evicted"]:
        return f"fits after {', '.join(evicted)} left"
    return "fits"


def _queued(data: Mapping[str, Any]) -> str:
    if data.get("grows"):
        return f"{data['grows']} grows by {data['more_bytes']}"
    if data.get("behind"):
        return f"waits behind {data['behind']} as number {data['position']}"
    return (
        explained.WAIT[data["wait"]] if data.get("wait") else explained.wait_for(data.get("block"))
    )


def _gang(data: Mapping[str, Any]) -> str:
    return {"loading": "all fit", "complete": "all are held"}.get(data["phase"], "")


def _resized(data: Mapping[str, Any]) -> str:
    changed = data["changed_bytes"]
    if not changed:
        return "the bytes did not come back in time"
    return "grown" if changed > 0 else "shrunk"


def _away(data: Mapping[str, Any]) -> str:
    by_itself = "by itself when there is room"
    return f"comes back {by_itself if data['comes_back'] else 'when its holder asks'}"


def _oom(data: Mapping[str, Any]) -> str:
    learned = data["learnt_load_peak_bytes"] is not None
    return (
        "it needs more than it declared" if learned else "another process holds what it was granted"
    )


def _drift(data: Mapping[str, Any]) -> str:
    side = "above" if data["drift_bytes"] > 0 else "below"
    return f"its {data['part'].replace('_', ' ')} is {side} what it declared"


def _signalled(data: Mapping[str, Any]) -> str:
    return (
        f"asked {data['asked_s']:.1f} s ago, idle, and its lease says "
        f"on_overstay={data['on_overstay']}"
    )


def _expired_note(data: Mapping[str, Any]) -> str:
    if data["why"] is Why.NOT_RENEWED:
        return f"{data['lease_id']} was not renewed for {data['ttl_s']:g} s"
    return _why(data["why"])


_REASONS: Final[Mapping[str, Callable[[Mapping[str, Any]], str]]] = {
    "granted": _granted,
    "queued": _queued,
    "gang": _gang,
    "resized": _resized,
    "standby": _away,
    "parked": _away,
    "oom": _oom,
    "drift": _drift,
    "signalled": _signalled,
    "expired": _expired_note,
    "revoke_asked": lambda data: cause(
        RevokeCause(data["cause"], data["wanted_by"], data.get("gang", ""), data.get("order"))
    ),
    "pressure": lambda data: (
        "more is held than the budget" if data["pressure_bytes"] else "pressure is over"
    ),
    "stowaway": lambda data: "holds bytes without a lease; charged as reserve",
    "lost": lambda data: (
        f"{data['lease_id']}: process {data['pid']} died" if data.get("pid") else _why(data["why"])
    ),
}
