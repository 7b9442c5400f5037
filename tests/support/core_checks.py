"""What must hold of everything that passes through an engine in a test: events, effects and
answers."""

from collections.abc import Sequence

from tests.support.typed import mistyped
from vram_arbiter.arbiter.core.effects import Effect, Note, Refuse, Reply
from vram_arbiter.arbiter.core.events import Asked, Event
from vram_arbiter.arbiter.core.model.state import Inspection
from vram_arbiter.schemas.wire.notes import OperatorNote, RefusedNote

NOT_OF_A_LEASE = frozenset(
    [
        "pressure",
        "stowaway",
        "probe_failed",
        "probe_ok",
        "journal_failed",
        "recovered",
        "serving",
        "resumed",
        "drain",
        "resume",
    ]
)
"""Kinds of notes, and an operator's orders, that are about a GPU or the daemon."""


def well_formed(event: Event, effects: Sequence[Effect], state: Inspection) -> None:
    """Raise AssertionError unless every request has its one answer, notes name their lease, and
    every field of an effect, and of the leases that notes are about, is of its type."""
    asked = [(event.client, event.id)] if isinstance(event, Asked) else []
    answered = [(e.client, e.request) for e in effects if isinstance(e, Reply | Refuse)]
    if answered != asked:
        raise AssertionError(f"{asked} asked, {answered} answered: {effects}")
    for note in (e for e in effects if isinstance(e, Note)):
        name = note.body.action if isinstance(note.body, OperatorNote) else note.kind
        may_be_either = isinstance(note.body, RefusedNote)
        if not may_be_either and (note.about is None) != (name in NOT_OF_A_LEASE):
            raise AssertionError(f"about another thing: {note}")
    abouts = [e.about for e in effects if isinstance(e, Note) and e.about is not None]
    told = {about.lease_id for about in abouts if about.lease_id is not None}
    known = [table[lease] for table in (state.leases, state.ended) for lease in told & table.keys()]
    well_typed(*effects, *known)


def well_typed(*told: object) -> None:
    """Raise AssertionError if a field of these dataclasses is not of its type."""
    if odd := next(filter(None, map(mistyped, told)), ""):
        raise AssertionError(f"not of its type: {odd}")
