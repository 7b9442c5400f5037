"""Watch over the robot while an episode runs and the planner thinks.

An emergency stop or a lost runner ends the episode, a runner that hangs up at once; a sensor or
joint state that has become stale is reported to the planner. Reads the runner's state once a second
on a connection of its own, so that no other request delays it.
"""

import asyncio
import contextlib
import logging

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.reasoner.inbox import Danger, Inbox
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.goals import GetState
from vram_arbiter.schemas.plain import Message

log = logging.getLogger(__name__)

PERIOD_S = 1.0
ANSWER_S = 10.0  # a machine that loads models is slow
LOST_MAX = 3  # answers missed in a row


async def watch(
    runner: RunnerClient,
    inbox: Inbox,
    session: str = "",
    *,
    period_s: float = PERIOD_S,
    answer_s: float = ANSWER_S,
) -> None:
    """Run until the episode must stop, or until canceled.

    `session` is that of the runner that the task began with; "" is not compared.
    """
    try:
        danger = await _danger(runner, inbox, session, period_s, answer_s)
    except Exception as error:
        log.exception("the watch over the robot failed")
        danger = f"the robot is not watched any more: {type(error).__name__}: {error}"
    inbox.put(Danger(danger, stop=True))


async def _danger(
    runner: RunnerClient, inbox: Inbox, session: str, period_s: float, answer_s: float
) -> str:
    """Return why the episode must stop."""
    lost = 0
    told: set[str] = set()  # stale components that the planner has heard of
    while True:
        try:
            state = await runner.call(GetState(), timeout_s=answer_s)
        except VramError as error:
            lost += 1
            log.warning("%s", error)
            if lost >= LOST_MAX or not runner.connected:
                return f"the runner is gone: {error}"
        else:
            lost = 0
            if stopped := state.get("estop"):
                return f"emergency stop: {stopped}"
            if session and state.get("session") != session:
                return "the runner was started again"
            stale = _stale(state)
            if new := stale - told:
                inbox.put(
                    Danger(f"not to be trusted now, too old: {', '.join(sorted(new))}", stop=False)
                )
            told = stale
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(period_s):
                await runner.until_lost()
            return "the runner is gone: it hung up"


def _stale(state: Message) -> set[str]:
    diagnostics = (state.get("world") or {}).get("diagnostics") or {}
    return {name for name, said in diagnostics.items() if said in ("stale", "error")}
