"""Dataclasses of the wire, which may say their kind in their plain form. Standard library only."""

from dataclasses import dataclass
from typing import ClassVar, dataclass_transform


@dataclass_transform(frozen_default=True)
class Tagged:
    """Base of requests, replies, pushes and notes, which are dataclasses: the map of
    `class GrantedNote(Tagged, kind="granted")` has that key (`schemas.codec`).

    They are frozen for the type checker alone: to make and to use the methods that freeze them
    would be a twelfth of the daemon's start, and half of the time that makes a note.
    """

    TAG: ClassVar[tuple[str, str]]

    def __init_subclass__(cls, *, kw_only: bool = False, **tag: str) -> None:
        super().__init_subclass__()
        for pair in tag.items():
            cls.TAG = pair
        dataclass(kw_only=kw_only)(cls)


class AnyReply(Tagged):
    """Base of all replies. A reply has no tag: it is known by its request."""
