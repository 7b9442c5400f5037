"""What this process asks of the machine so that its control loop begins each tick on time, beside programs that take all cores.

Asked once, when everything is imported and built. Each of the three may be refused (a container, no `LimitRTPRIO=`): the runner then works on
without it and says so. Knows no robot.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
from dataclasses import dataclass

from vram_arbiter.runner.control.clock import BUSY_TAIL_S
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.schemas.errors import InternalError

log = logging.getLogger("runner")

SWITCH_S = 0.0005  # Python hands the interpreter over every 5 ms; a thread that wakes for its tick must not wait that long
REALTIME_PRIORITY = 1  # the lowest: before every ordinary program, behind all that is as urgent
AWAKE_MAX = 0.5  # of each period; the kernel stops a real-time thread that never sleeps for 50 ms of every second
NICE = -10  # of the ordinary threads: whoever holds the interpreter must not be kept from running while the loop waits for it


@dataclass(frozen=True, slots=True)
class Promptness:
    """What was granted to a thread: real time, or else its nice value."""

    realtime: bool
    nice: int

    def __str__(self) -> str:
        return "real time" if self.realtime else f"nice {self.nice}"


def settle_interpreter() -> None:
    """For the whole process, once all is imported: quick changes between threads, and no collector walking a million objects that stay."""
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()


def leaves_room(rate_hz: float) -> bool:
    """Whether a loop of this rate sleeps enough to go before other programs: it is awake for the end of every wait. 0: it never waits."""
    return 0 < rate_hz * BUSY_TAIL_S <= AWAKE_MAX


def hasten(*, realtime: bool = False) -> Promptness:
    """For the calling thread: real time if asked for and allowed, else a low nice value if allowed.

    Threads and programs that a thread in real time starts do not inherit it.
    """
    if realtime:
        with contextlib.suppress(OSError):  # EPERM: the limits say no
            os.sched_setscheduler(
                0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(REALTIME_PRIORITY)
            )
            return Promptness(True, os.getpriority(os.PRIO_PROCESS, 0))
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, min(NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    return Promptness(False, os.getpriority(os.PRIO_PROCESS, 0))


async def make_prompt(control: ControlThread, *, first: bool) -> None:
    """Call it when the runner is ready to serve, from its event loop. `first`: the control thread and the caller's go before other programs.

    Not for a loop that hardly sleeps (`leaves_room`): it would leave nothing to the others.
    """
    settle_interpreter()
    if not first:
        return
    sockets = hasten()
    try:
        loop = await control.call(lambda: hasten(realtime=True))
    except InternalError:
        return  # the run is over already, and whoever awaits its end hears why
    if loop.realtime or loop.nice < 0:
        log.info("the control loop runs at %s, the sockets at %s", loop, sockets)
    else:
        log.info(
            "the control loop shares the cores evenly: neither real time nor a low nice value is allowed"
            " (LimitRTPRIO=1, LimitNICE=-10)"
        )
