"""Scheduling requests of this process, so that ticks begin on time beside busy programs.

Made once, when everything is imported and built. Each may be refused (a container, no
`LimitRTPRIO=`): the runner then works without it and logs so. Must not know the robot.
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

# Python switches threads every 5 ms; a thread that wakes for its tick must not wait that long
SWITCH_S = 0.0005
REALTIME_PRIORITY = 1  # the lowest: before every ordinary program, behind all that is as urgent
# of each period; the kernel stops a real-time thread that never sleeps for 50 ms of every second
AWAKE_MAX = 0.5
# of ordinary threads: the holder of the interpreter lock has to run while the loop waits for it
NICE = -10


@dataclass(frozen=True, slots=True)
class Promptness:
    """What was granted to a thread: real time, or else its nice value."""

    realtime: bool
    nice: int

    def __str__(self) -> str:
        return "real time" if self.realtime else f"nice {self.nice}"


def settle_interpreter() -> None:
    """Switch threads quickly, and keep the garbage collector off the objects that stay.

    For the whole process, once everything is imported.
    """
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()


def leaves_room(rate_hz: float) -> bool:
    """Return whether a loop of this rate sleeps enough to run before other programs.

    It is awake for the end of every wait. Rate 0 never waits.
    """
    return 0 < rate_hz * BUSY_TAIL_S <= AWAKE_MAX


def hasten(*, realtime: bool = False) -> Promptness:
    """Raise the priority of the calling thread.

    Real time if asked for and allowed, else a low nice value if allowed. Threads and programs that
    a real-time thread starts do not inherit it.
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
    """Raise the priority of the control loop.

    Call it from the runner's event loop once it can serve.

    Args: `first` runs the control thread and the calling thread before other programs; not for a
    loop that hardly sleeps (`leaves_room`), which would starve the others.
    """
    settle_interpreter()
    if not first:
        return
    sockets = hasten()
    try:
        loop = await control.call(lambda: hasten(realtime=True))
    except InternalError:
        return  # the run is over already; its awaiter gets the error
    if loop.realtime or loop.nice < 0:
        log.info("the control loop runs at %s, the sockets at %s", loop, sockets)
    else:
        log.info(
            "the control loop shares the cores evenly:"
            " neither real time nor a low nice value is allowed"
            " (LimitRTPRIO=1, LimitNICE=-10)"
        )
