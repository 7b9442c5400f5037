"""Hints to the arbiter: which skill's model is wanted next.

A hint may come to nothing (no arbiter, no sidecar of that name, no host RAM): nothing depends on
it, and its failure is a line of the log.
"""

from __future__ import annotations

import logging

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.endpoints import sidecar_name

log = logging.getLogger(__name__)


class Hints:
    """Says by one short connection each that a skill follows."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint

    async def follows(self, rskill_id: str) -> None:
        """Tell the arbiter that the model of `rskill_id` is wanted soon. Raises nothing."""
        if not is_listening(self._endpoint):
            log.debug("no arbiter to be told that %s follows", rskill_id)
            return
        name = sidecar_name(rskill_id)
        try:
            async with AsyncClient("reasoner", endpoint=self._endpoint) as arbiter:
                told = (await arbiter.prepare(name)).told
        except VramError as error:
            log.info("the arbiter was not told that %s follows: %s", rskill_id, error)
            return
        log.info("%s follows: %s", rskill_id, f"{name} was told" if told else f"no {name} is here")
