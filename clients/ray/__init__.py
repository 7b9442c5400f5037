"""Fleets of boxes: Ray places actors on them and restarts them, each box's arbiter decides what its
GPU holds.

    from vram_arbiter.clients.ray import Fleet, leased

Only modules of this package import Ray, and only inside the functions that need it.
"""

from vram_arbiter.clients.ray.fleet import Fleet
from vram_arbiter.clients.ray.leased import LeasedSpec, idempotent, leased
from vram_arbiter.clients.ray.mapping import Result
from vram_arbiter.clients.ray.placement import Ranked, Reason, Room, View
from vram_arbiter.clients.ray.residency import Refused

__all__ = [
    "Fleet",
    "LeasedSpec",
    "Ranked",
    "Reason",
    "Refused",
    "Result",
    "Room",
    "View",
    "idempotent",
    "leased",
]
