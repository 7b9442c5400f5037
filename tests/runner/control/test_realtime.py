"""The control loop goes before other programs where the machine allows it, and works where it does
not.
"""

import asyncio
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from tests.support.paths import ROOT
from vram_arbiter.runner.control.clock import precise_sleep
from vram_arbiter.runner.control.realtime import (
    NICE,
    SWITCH_S,
    Promptness,
    hasten,
    leaves_room,
    make_prompt,
)
from vram_arbiter.runner.control.thread import ControlThread


def in_thread[T](work: Callable[[], T]) -> T:
    found: list[T] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


def test_what_was_granted_is_what_the_kernel_says() -> None:
    def ask() -> tuple[Promptness, int, int]:
        return hasten(realtime=True), os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)

    granted, policy, nice = in_thread(ask)
    assert granted.realtime == (policy & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
    assert granted.nice == nice
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "only the thread that asked"


def test_programs_that_it_starts_are_ordinary_ones() -> None:
    def ask() -> str:
        hasten(realtime=True)
        code = "import os; print(os.sched_getscheduler(0))"
        return subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout

    assert in_thread(ask).split() == [str(os.SCHED_OTHER)]


def test_where_nothing_is_allowed_it_goes_on_without() -> None:
    code = (
        "import os, resource\n"
        "from vram_arbiter.runner.control.realtime import hasten\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_NICE, (0, 0))\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "print(hasten(realtime=True), os.sched_getscheduler(0))\n"
    )
    environ = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environ,
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    assert done.stdout.split() == ["nice", str(nice), str(os.SCHED_OTHER)]


def test_both_threads_are_asked_for_unless_the_loop_is_unpaced(
    make_runner: Callable[..., Any],
) -> None:
    async def granted(first: bool) -> tuple[Promptness, int]:
        async with ControlThread(make_runner(rate_hz=100)) as control:
            await make_prompt(control, first=first)

            def look() -> Promptness:
                fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
                return Promptness(fifo, os.getpriority(os.PRIO_PROCESS, 0))

            return await control.call(look), os.getpriority(os.PRIO_PROCESS, 0)

    def run(first: bool) -> tuple[Promptness, int]:
        before = sys.getswitchinterval()
        try:
            return asyncio.run(granted(first))
        finally:
            assert sys.getswitchinterval() == SWITCH_S
            sys.setswitchinterval(before)

    ours = os.getpriority(os.PRIO_PROCESS, 0)
    assert in_thread(lambda: run(False)) == (Promptness(False, ours), ours)
    may = in_thread(lambda: hasten(realtime=True))
    loop, sockets = in_thread(lambda: run(True))
    assert loop.realtime == may.realtime
    assert sockets == in_thread(hasten).nice
    assert sockets in (NICE, ours)


def test_a_loop_that_hardly_sleeps_does_not_go_first() -> None:
    """Its wait's last millisecond is spent awake: at 1000 Hz all of it, and a real-time thread
    would keep its core to itself.
    """
    slept: list[float] = []
    precise_sleep(1 / 1000, sleep=slept.append)
    assert slept == []
    assert [leaves_room(rate) for rate in (0.0, 30.0, 500.0, 501.0, 1000.0)] == [
        False,
        True,
        True,
        False,
        False,
    ]
