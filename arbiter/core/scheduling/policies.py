"""Scheduling policies by name: what `Settings.policy` may say and what each changes in the engine.

A policy chooses which request is next and which holder is revoked. Bytes, safe points, verdicts and
invariants are the same under each: none can overfill a GPU. Data only; `queue`, `victims`,
`backfill` and `requests` each read their flag.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class Scheduling:
    """One policy. The defaults are the policy `default`."""

    summary: str
    by_priority: bool = True
    """Waiters by priority with ageing; False: strictly as they came."""
    backfill: bool = True
    """A small waiter may pass the head if that cannot delay it."""
    least_recent: bool = False
    """Victims by least recent use alone, until enough is covered; False: the cheapest set that
    covers the need.
    """
    alone: bool = False
    """Every lease is exclusive: one model at a time per card."""


SCHEDULING: Mapping[str, Scheduling] = MappingProxyType(
    {
        DEFAULT: Scheduling(
            "priority with ageing, conservative backfill, cheapest covering victims"
        ),
        "fifo": Scheduling(
            "strictly as they came, without backfill", by_priority=False, backfill=False
        ),
        "no_backfill": Scheduling("default, but without backfill", backfill=False),
        "lru": Scheduling(
            "default, but the least recently used leave, whatever they hold", least_recent=True
        ),
        "one_model": Scheduling("default, but one model at a time per card", alone=True),
    }
)
