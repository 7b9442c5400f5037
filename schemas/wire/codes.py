"""Codes for why things happen, as history, errors and views carry them. Standard library only;
words are made elsewhere."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


@dataclass(frozen=True, slots=True)
class Order:
    """An operator's order: `by` has the operator's name, uid and pid."""

    by: str
    reason: str

    def __str__(self) -> str:
        return f"{self.by}: {self.reason}" if self.reason else self.by


type Cause = Literal["waiter", "pressure", "operator"]
"""Why a holder is revoked: for a request, because the GPU holds more than its budget, or
by hand."""


@dataclass(frozen=True, slots=True)
class RevokeCause:
    """Why a holder is revoked. `wanted_by`: the consumer of the waiter."""

    cause: Cause
    wanted_by: str = ""
    order: Order | None = None


class Why(StrEnum):
    """Why a lease, a request or a use changed."""

    # steps of a lease
    ACQUIRED = "acquired"
    GRANTED = "granted"
    RETURNED = "returned"  # from standby, by itself
    READY = "ready"
    REVOKED = "revoked"
    WITHDRAWN = "withdrawn"  # the revoke: nothing wants the bytes any more
    SAFE_POINT = "safe_point"
    LET_GO = "let_go"  # the holder released
    LET_GO_BEFORE = "let_go_before"  # its holder said so after a restart
    EXITS = "exits"
    BYE = "bye"
    RECOVERED = "recovered"  # from the journal
    ADOPTED = "adopted"  # the journal did not know it
    WANTED = "wanted"  # again, by its holder
    # ends
    HOLDER_GAVE_UP = "holder_gave_up"
    CLIENT_LEFT = "client_left"
    PROCESS_DIED = "process_died"
    NOT_RENEWED = "not_renewed"
    GIVEN_UP = "given_up"  # by an operator
    EVICTED = "evicted"  # by an operator, while away
    NOT_BACK = "not_back"  # its holder, after a restart
    NOT_HELD = "not_held"  # it is over since before a restart
    UNKNOWN = "unknown"  # neither the journal nor the engine knows it
    # uses
    ENDED = "ended"
    USER_NOT_BACK = "user_not_back"  # its process, after a restart


class Wait(StrEnum):
    """Why a request waits, as its GPU saw it last."""

    MAKING_ROOM = "making_room"
    READING = "reading"  # no reading is young enough
    NOT_FREE = "not_free"  # the ledger has room, the measurement does not
    RESIDUE = "residue"  # the memory of a dead process is measured
    NO_VICTIM = "no_victim"  # no holder that could make room may be revoked now


class Block(StrEnum):
    """Why nothing is granted on a GPU."""

    RECOVERING = "recovering"
    DRAINED = "drained"
    UNREADABLE = "unreadable"
    UNREAD = "unread"  # no reading yet
    LOADING = "loading"
    PRESSURE = "pressure"
    NOT_FREE = "not_free"
