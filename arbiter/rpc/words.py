"""English for plain wire clients, history and logs: the engine's codes and values in words.

The engine holds no prose, so that rewording a message changes no decision and no replay. Each error
says what is wrong, with values, then what to do. `arbiter.rpc.explained` does the same for answers
to `why`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.model import refusals as r
from vram_arbiter.arbiter.rpc import explained
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.sizes import format_bytes as size
from vram_arbiter.schemas.wire import notes
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
    Why.NOT_BACK: "its holder did not reattach after the restart",
    Why.NOT_HELD: "it is no longer held",
    Why.UNKNOWN: "it is not known",
    Why.ENDED: "ended",
    Why.USER_NOT_BACK: "its process did not come back to it after the restart",
    Why.LET_GO: "released by its holder",
    Why.LET_GO_BEFORE: "released before the restart, according to its holder",
    Why.EXITS: "its process exits",
    Why.BYE: "its client said bye",
}


# -- errors
def error_view(refusal: Refusal) -> ErrorView:
    """Return the error of a refusal with its words: what is wrong, then what to do."""
    if isinstance(refusal, r.TimedOut):
        refusal = replace(refusal, why=explained.worded(refusal.why))
    if isinstance(refusal, r.TargetOver):
        ended = error_view(refusal.ended)
        return replace(ended, hint="it is over; see `vramctl history`")
    words = _ERRORS[type(refusal)]
    message, hint = words(refusal) if callable(words) else _filled(words, refusal)
    return ErrorView(refusal.code, message, hint, to_map(refusal))


type _Words = tuple[str, str]
"""What is wrong, and what to do."""

_ACQUIRE = "unload, then acquire again"
_LOOK = "see `vramctl status`"
_END_PINNED = "end its program: a pinned holder is never evicted"

_MISFITS: Final[Mapping[r.Misfit, str]] = {
    r.Misfit.STILL_QUEUED: "it is still queued",
    r.Misfit.NOT_AWAY: "only a lease that is away, or being measured on its way there, is called "
    "back",
    r.Misfit.GRANTED: "it is already granted: release it",
    r.Misfit.NOT_LOADING: "only a loading lease becomes ready",
    r.Misfit.NOT_HELD: "only a held lease can be used",
    r.Misfit.NOT_UNLOADABLE: "only a held lease is unloaded; a loading one is released",
    r.Misfit.IN_USE: "{no.uses} uses still run; wait for the `revoke` that says 0 uses",
    r.Misfit.EXITS: "it cannot be parked: a process that exits keeps nothing",
    r.Misfit.NO_PARK_BYTES: "it cannot be parked: its spec has no park_bytes",
    r.Misfit.HOLDS_NOTHING: "it holds nothing",
    r.Misfit.NOT_REATTACHED: "the arbiter was restarted: reattach it first",
}

_IMPRACTICAL: Final[Mapping[r.Impractical, _Words]] = {
    r.Impractical.NOT_RESIDENT: (
        "{no.lease_id} is {no.state}: only a resident lease can be evicted", _LOOK
    ),
    r.Impractical.LEAVING: ("{no.lease_id} is {no.state}: it was revoked already", _LOOK),
    r.Impractical.NOT_HELD: ("{no.lease_id} is {no.state}: it has no holder", _LOOK),
    r.Impractical.IN_USE: (
        "{no.lease_id} is {no.state}: it is in use; a holder in use is never given up", _LOOK
    ),
    r.Impractical.OTHERS_USE: (
        "{no.lease_id} is {no.state}: its process and another one are in the middle of a use",
        "end the use first, such as the robot's goal",
    ),
    r.Impractical.PINNED_BY_OPERATOR: (
        "{no.lease_id} is pinned: an operator pinned it", "unpin it first"
    ),
    r.Impractical.PINNED_BY_HOLDER: (
        "{no.lease_id} is pinned: its holder asked never to be evicted", _END_PINNED
    ),
    r.Impractical.NOT_PINNED: ("no operator pinned {no.lease_id}", "nothing to undo"),
    r.Impractical.HOLDER_LIVES: (
        "the holder of {no.lease_id} was heard from {no.silent_s:.1f} s ago: it is not dead",
        "evict it instead",
    ),
}  # fmt: skip

_PINNED_HINTS: Final[Mapping[r.Impractical, str]] = {
    r.Impractical.NOT_PINNED: "its holder asked never to be evicted, and it alone can change that",
    r.Impractical.HOLDER_LIVES: "end its program: it is pinned",
}
"""Hints that differ for a lease that is never evicted."""

_LIMITS: Final[Mapping[r.Limit, _Words]] = {
    "waiters_max": (
        "requests wait", "wait until some are answered, or raise limits.waiters_max"
    ),
    "leases_per_client_max": (
        "leases are held or asked for", "release some, or raise limits.leases_per_client_max"
    ),
    "uses_per_lease_max": (
        "uses of {no.lease_id} run", "end some, or raise limits.uses_per_lease_max"
    ),
}  # fmt: skip

_SHARES: Final[Mapping[r.Share, str]] = {
    r.Share.CONNECTION: "by this connection",
    r.Share.PROCESS: "of this process",
    r.Share.USER: "of uid {no.uid}",
    r.Share.ALL: "of all users",
    r.Share.HOLDER: "of its holder",
    r.Share.OTHERS: "of processes other than its holder",
}


def _filled(words: _Words, refusal: Refusal) -> _Words:
    """Return templates with the values of a refusal. No value is read as a template."""
    return words[0].format(no=refusal), words[1].format(no=refusal)


def _bad_lease_state(no: r.BadLeaseState) -> _Words:
    return _filled(
        (
            "{no.lease_id} is {no.state}: " + _MISFITS[no.misfit],
            "details.story has its last changes",
        ),
        no,
    )


def _bad_target_state(no: r.BadTargetState) -> _Words:
    message, hint = _IMPRACTICAL[no.problem]
    return _filled((message, hint if no.evictable else _PINNED_HINTS.get(no.problem, hint)), no)


def _too_large(no: r.TooLarge) -> _Words:
    raised = no.needed_bytes > no.declared_bytes
    learned = f" ({size(no.declared_bytes)} declared, more was measured)" if raised else ""
    return (
        f"{no.consumer} needs {size(no.needed_bytes)}{learned}; the GPU has "
        f"{size(no.capacity_bytes)} less a reserve of {size(no.reserve_bytes)}",
        "use a smaller model or a lower precision",
    )


def _revoked(no: r.Revoked) -> _Words:
    told = "" if no.revoked is None else f": {cause(no.revoked)}"
    return f"{no.consumer} was revoked{told}", "wait until it is granted again"


def _limit(no: r.LimitReached) -> _Words:
    what, hint = _LIMITS[no.limit]
    message = f"{{no.count}} {what} {_SHARES[no.share]}, the limit is {{no.value}}"
    return _filled((message, hint), no)


def _expired(no: r.Expired) -> _Words:
    given_up = no.why is Why.GIVEN_UP
    told = f"was given up by {no.order}" if given_up else f"was not renewed for {no.ttl_s:g} s"
    return f"{no.lease_id} {told}", _ACQUIRE


def _lost(no: r.Lost) -> _Words:
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


_ERRORS: Final[Mapping[type[Refusal], _Words | Callable[[Any], _Words]]] = {
    r.NoSession: ("this connection has not said hello", "say hello, then reattach"),
    r.NoLease: (
        "there is no lease {no.lease_id}", "acquire one; after a restart: reattach"
    ),
    r.WrongToken: (
        "{no.token} is not the token of {no.lease_id}", "use the token that came with the grant"
    ),
    r.NotHolder: ("{no.lease_id} belongs to process {no.pid}", "ask as its holder"),
    r.CgroupTaken: (
        "the cgroup {no.cgroup} overlaps with {no.other}, whose bytes are {no.consumer}'s "
        "({no.lease_id})",
        "end that program first",
    ),
    r.BadLeaseState: _bad_lease_state,
    r.BadTargetState: _bad_target_state,
    r.Ambiguous: lambda no: (
        f"{no.target} has {len(no.leases)} leases", f"name one of them: {', '.join(no.leases)}"
    ),
    r.NoTarget: ("there is no lease or consumer {no.target!r}", _LOOK),
    r.LeaseOver: lambda no: (
        f"{no.lease_id} is {no.state}" + (f": {cause(no.revoked)}" if no.revoked else ""), _ACQUIRE
    ),
    r.Revoked: _revoked,
    r.UnknownGpu: ("there is no GPU {no.gpu!r}", "give a UUID, an index or `any`"),
    r.TooLarge: _too_large,
    r.NoHostRam: lambda no: (
        f"{size(no.needed_bytes)} of host RAM are asked for; of a budget of "
        f"{size(no.budget_bytes)} {size(no.booked_bytes)} are booked",
        "release without parking, or raise host.park_budget_bytes",
    ),
    r.LimitReached: _limit,
    r.LoadFails: lambda no: (
        f"{no.consumer} failed {no.failures} times in a row to load {no.model}: {_why(no.cause)}",
        f"no holder is revoked for it for another {no.retry_in_s:.0f} s; see its own log",
    ),
    r.CancelledRequest: lambda no: (f"{no.lease_id}: {_why(no.why, no.by)}", "acquire again"),
    r.TimedOut: (
        "{no.consumer} waited {no.waited_s:.1f} s: {no.why.text}", "wait longer, or make room"
    ),
    r.Expired: _expired,
    r.Lost: _lost,
    r.NotJournaled: (
        "the grant of {no.lease_id} could not be written: {no.problem}",
        "look at the daemon's log and its disk",
    ),
}  # fmt: skip
"""Templates with the refusal as `no`, or what makes the words of a class with variants."""


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
        case StatusReply(gpus=gpus, details=details):
            told = tuple(
                one if one.why is None else replace(one, why=explained.worded(one.why))
                for one in details
            )
            return replace(body, gpus=tuple(map(explained.worded_gpu, gpus)), details=told)
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
            return replace(body, reason=cause(body))
        case _:
            return body


def cause(why: RevokeCause | RevokePush) -> str:
    """Return why a holder is revoked."""
    if why.order is not None:
        return f"evicted by {why.order}"
    if why.cause == "pressure":
        return "the GPU holds more than its budget"
    return f"{why.wanted_by} needs the room"


def _why(code: str, by: str = "") -> str:
    words = WHY.get(code, code)  # type: ignore[call-overload]
    return f"{words}: {by}" if by else str(words)


# -- events
def event(note: Note) -> JsonObject:
    """Return the event of a note as history keeps it: plain values, and `reason` in words. A
    process that had no lease is named by its `pid`."""
    body, about = note.body, note.about
    reason = _reason(body, about)
    plain = {**({} if about is None else to_map(about)), **to_map(body)}
    if about is not None and about.lease_id is None:
        pid, at, _ = about.consumer.partition("@")
        if at and pid.isdecimal():
            del plain["consumer"]
            plain["pid"] = int(pid)
    if reason:
        plain.setdefault("reason", reason)
    return plain


def _reason(body: notes.AnyNote, about: notes.About | None) -> str:
    """Why it happened, in words; "" where the kind says it."""
    lease_id = "" if about is None else about.lease_id
    match body:
        case notes.GrantedNote(by_itself=True):
            return "back from standby: there is room and nothing waits"
        case notes.GrantedNote(evicted=evicted):
            return f"fits after {', '.join(evicted)} left" if evicted else "fits"
        case notes.ReleasedNote(why=why):
            return WHY.get(why, why)
        case notes.QueuedNote(behind=behind, position=position) if behind:
            return f"waits behind {behind} as number {position}"
        case notes.QueuedNote(wait=wait, block=block):
            return explained.wait_for(block) if wait is None else explained.WAIT[wait]
        case notes.DeniedNote(refusal) | notes.RefusedNote(_, refusal):
            return error_view(refusal).message
        case notes.RevokeAskedNote(wanted_by, _, _, why, order):
            return cause(RevokeCause(why, wanted_by, order))
        case notes.RevokeWithdrawnNote(cause="waiter", wanted_by=wanted_by):
            return f"{wanted_by} needs the room no longer"
        case notes.RevokeWithdrawnNote():
            return "the GPU is within its budget again"
        case notes.ExpiredNote(Why.NOT_RENEWED, ttl_s):
            return f"{lease_id} was not renewed for {ttl_s:g} s"
        case notes.LostNote(pid=int(pid)):
            return f"{lease_id}: process {pid} died"
        case notes.StandbyNote(comes_back=by_itself) | notes.ParkedNote(comes_back=by_itself):
            back = "by itself when there is room" if by_itself else "when its holder asks"
            return f"comes back {back}"
        case notes.OomNote(learnt_load_peak_bytes=None):
            return "another process holds what it was granted"
        case notes.OomNote():
            return "it needs more than it declared"
        case notes.DriftNote(part, drift_bytes=drift):
            side = "above" if drift > 0 else "below"
            return f"its {part.replace('_', ' ')} is {side} what it declared"
        case notes.PressureNote(pressure_bytes=over):
            return "more is held than the budget allows" if over else "pressure is over"
        case notes.StowawayNote():
            return "holds bytes without a lease; charged as reserve"
        case (
            notes.CancelledNote(why=why)
            | notes.UseEndedNote(why=why)
            | notes.ExpiredNote(why=why)
            | notes.LostNote(why=why)
        ):
            by = getattr(body, "by", "")
            return f"{WHY.get(why, why)}: {by}" if by else WHY.get(why, why)
        case _:
            return ""
