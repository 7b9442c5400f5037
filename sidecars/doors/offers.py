"""Sidecars that a door's clients may choose from: the door's own, and those that its operator
offers beside it."""

import contextlib
from collections.abc import Sequence
from typing import Final

from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import SidecarUnavailable, UnknownSkill
from vram_arbiter.schemas.sidecar import PingResult

FRESH_S: Final = 5.0
"""How old an observation may be when a model begins to look at it. A robot that waits for a load
longer than that is to look again: what it saw may have moved."""
PING_S: Final = 5.0  # of a sidecar that is offered and does not run


class Offers:
    """Clients of the sidecars behind a door, its own first. `timeout_s`: of one answer."""

    def __init__(self, endpoints: Sequence[str], timeout_s: float) -> None:
        self.clients = [PolicyClient(endpoint, timeout_s=timeout_s) for endpoint in endpoints]

    async def find(self, wanted: str) -> PolicyClient:
        """Return the sidecar that serves a skill, by the skill's name, its sidecar's name or its
        checkpoint. Nothing is started or loaded.

        Raises UnknownSkill.
        """
        offered = []
        for client in self.clients:
            with contextlib.suppress(SidecarUnavailable):
                identity = await client.ping(timeout_s=PING_S)
                if wanted in _names(identity):
                    return client
                offered.append(identity["rskill"])
        raise UnknownSkill(
            f"{wanted[:200]!r} is not offered here",
            hint=f"--pretrained_name_or_path is one of: {', '.join(offered)}",
            details={"offered": offered},
        )

    async def close(self) -> None:
        for client in self.clients:
            await client.close()


def _names(identity: PingResult) -> set[str]:
    skill, model = identity["rskill"], identity["model"]
    own = identity.get("consumer", skill)
    return {skill, skill.rpartition("/")[2], own, model, model.removeprefix("local://")}
