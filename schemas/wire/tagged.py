"""Dataclasses of the wire, which may say their kind in their plain form. Standard library only."""

from dataclasses import dataclass
from typing import ClassVar, dataclass_transform


@dataclass_transform(frozen_default=True)
class Tagged:
    """Base of requests, replies, pushes and notes, which are frozen dataclasses: the map of
    `class GrantedNote(Tagged, kind="granted")` has that key (`schemas.codec`)."""

    TAG: ClassVar[tuple[str, str]]

    def __init_subclass__(cls, *, kw_only: bool = False, **tag: str) -> None:
        super().__init_subclass__()
        for pair in tag.items():
            cls.TAG = pair
        dataclass(frozen=True, kw_only=kw_only)(cls)


class AnyReply(Tagged):
    """Base of all replies. A reply has no tag: it is known by its request."""
