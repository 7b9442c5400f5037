"""Dataclasses that say their kind in their plain form. Standard library only."""

from dataclasses import dataclass
from typing import ClassVar, dataclass_transform


@dataclass_transform(frozen_default=True)
class Tagged:
    """Base of requests, pushes and notes: `class GrantedNote(Tagged, kind="granted")` is a frozen
    dataclass whose map has that key (`schemas.codec`)."""

    TAG: ClassVar[tuple[str, str]]

    def __init_subclass__(cls, *, kw_only: bool = False, **tag: str) -> None:
        super().__init_subclass__()
        for pair in tag.items():
            cls.TAG = pair
        dataclass(frozen=True, kw_only=kw_only)(cls)
