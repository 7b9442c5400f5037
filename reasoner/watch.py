"""Watch over the robot while an episode runs and the planner thinks.

An emergency stop or a lost runner ends the episode; a sensor or joint state that has become stale
is reported to the planner. Reads the runner's state once a second on a connection of its own, so
that no other request delays it.
"""

import asyncio
import logging

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.reasoner.inbox import Danger, Inbox
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import Message

log = logging.getLogger(__name__)

PERIOD_S = 1.0
ANSWER_S = 10.0  # a machine that loads models is slow
LOST_MAX = 3  # answers missed in a row


async def watch(
    runner: RunnerClient, inbox: Inbox, *, period_s: float = PERIOD_S, answer_s: float = ANSWER_S
) -> None:
    """Run until the episode must stop, or until canceled."""
    try:
        await _watch(runner, inbox, period_s, answer_s)
    except Exception as error:
        log.exception("the watch over the robot failed")
        inbox.put(
            Danger(f"the robot is not watched any more: {type(error).__name__}: {error}", stop=True)
        )


async def _watch(runner: RunnerClient, inbox: Inbox, period_s: float, answer_s: float) -> None:
    lost = 0
    told: set[str] = set()  # stale components that the planner has heard of
    while True:
        try:
            state = await runner.call("state", timeout_s=answer_s)
        except VramError as error:
            lost += 1
            log.warning("%s", error)
            if lost >= LOST_MAX:
                inbox.put(Danger(f"the runner is gone: {error}", stop=True))
                return
        else:
            lost = 0
            if stopped := state.get("estop"):
                inbox.put(Danger(f"emergency stop: {stopped}", stop=True))
                return
            stale = _stale(state)
            if new := stale - told:
                inbox.put(
                    Danger(f"not to be trusted now, too old: {', '.join(sorted(new))}", stop=False)
                )
            told = stale
        await asyncio.sleep(period_s)


def _stale(state: Message) -> set[str]:
    diagnostics = (state.get("world") or {}).get("diagnostics") or {}
    return {name for name, said in diagnostics.items() if said in ("stale", "error")}
