"""Deaths are reported once, at once, and for the right process. Real processes, real pidfds."""

import asyncio
import contextlib
import os
import signal
import subprocess
from collections.abc import Awaitable, Callable, Iterator

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.host.process_watch import ProcessWatch
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.procfs import start_ticks

Programs = Callable[[], "subprocess.Popen[bytes]"]
Died = "asyncio.Queue[ProcessKey]"


@pytest.fixture
def idle_programs() -> Iterator[Programs]:
    """Makes processes that wait for their stdin to close."""
    made: list[subprocess.Popen[bytes]] = []

    def make() -> "subprocess.Popen[bytes]":
        made.append(subprocess.Popen(["cat"], stdin=subprocess.PIPE))
        return made[-1]

    yield make
    for child in made:
        if child.poll() is None:
            child.kill()
        child.communicate()


def key_of(child: "subprocess.Popen[bytes]") -> ProcessKey:
    ticks = start_ticks(child.pid)
    assert ticks is not None
    return ProcessKey(child.pid, ticks)


def watching(test: Callable[[ProcessWatch, Died], Awaitable[None]]) -> None:
    async def run() -> None:
        died: asyncio.Queue[ProcessKey] = asyncio.Queue()
        watch = ProcessWatch(asyncio.get_running_loop(), start_ticks, died.put_nowait)
        try:
            async with asyncio.timeout(PATIENCE_S):
                await test(watch, died)
        finally:
            watch.close()

    asyncio.run(run())


def watched() -> int:
    """Descriptors of processes that this one has open. Of others, earlier tests may have left some
    that are closed at any moment."""
    found = []
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the listing's own
            found.append(os.readlink(f"/proc/self/fd/{number}"))
    return sum("pidfd" in link for link in found)


def test_a_process_is_watched_by_the_descriptor_of_its_connection(idle_programs: Programs) -> None:
    """Between a connection's accept and its hello the process may die and its pid be reused: the
    pidfd still names the first one."""

    async def test(watch: ProcessWatch, died: Died) -> None:
        child = idle_programs()
        key, pidfd = key_of(child), os.pidfd_open(child.pid)
        child.kill()
        child.communicate()  # reaped: nothing has this pid now, or something else has
        try:
            assert watch.take(key, pidfd)
            assert not watch.take(key, pidfd), "it is watched once"
        finally:
            os.close(pidfd)  # the connection's own
        assert await died.get() == key
        assert len(watch) == 0

    watching(test)


def test_a_process_that_is_dropped_is_not_reported(idle_programs: Programs) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        dropped, other = idle_programs(), idle_programs()
        before = watched()
        watch.add(key_of(dropped))
        watch.add(key_of(other))
        watch.drop(key_of(dropped))
        watch.drop(key_of(dropped))
        assert watched() == before + 1
        key = key_of(other)
        dropped.kill()
        dropped.wait()
        other.kill()
        assert await died.get() == key
        assert died.empty()

    watching(test)


def test_a_killed_process_is_reported_once_before_it_is_reaped(idle_programs: Programs) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        child, other = idle_programs(), idle_programs()
        watch.add(key_of(child))
        watch.add(key_of(child))
        watch.add(key_of(other))
        key = key_of(child)
        child.kill()
        assert await died.get() == key
        await asyncio.sleep(0)
        assert died.empty()
        assert len(watch) == 1

    watching(test)


def test_a_process_that_is_dead_already_is_reported_but_not_from_inside_add(
    idle_programs: Programs,
) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        child = idle_programs()
        key = key_of(child)
        child.kill()
        child.communicate()
        watch.add(key)
        watch.add(key)
        assert died.empty()
        assert await died.get() == key
        assert len(watch) == 0

    watching(test)


def test_a_reused_pid_is_the_death_of_the_one_that_was_meant(idle_programs: Programs) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        child = idle_programs()
        earlier = ProcessKey(child.pid, key_of(child).start_ticks - 100)
        watch.add(earlier)
        assert await died.get() == earlier
        assert child.poll() is None

    watching(test)


def test_an_unknown_start_time_is_watched_by_pid(idle_programs: Programs) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        child = idle_programs()
        watch.add(ProcessKey(child.pid, 0))
        child.kill()
        assert await died.get() == ProcessKey(child.pid, 0)

    watching(test)


def test_no_descriptor_is_left_behind(idle_programs: Programs) -> None:
    async def test(watch: ProcessWatch, died: Died) -> None:
        made = [idle_programs() for _ in range(5)]
        keys = [key_of(child) for child in made]
        before = watched()
        for key in keys:
            watch.add(key)
        assert watched() == before + 5
        for child in made[:3]:
            child.kill()
        assert {await died.get() for _ in range(3)} == set(keys[:3])
        assert watched() == before + 2
        watch.add(ProcessKey(keys[3].pid, 1))  # another start time
        assert watched() == before + 2
        watch.close()
        assert watched() == before

    watching(test)


@pytest.mark.parametrize(("kind", "number"), [("term", signal.SIGTERM), ("kill", signal.SIGKILL)])
def test_a_signal_goes_through_the_descriptor(
    idle_programs: Programs, kind: str, number: signal.Signals
) -> None:
    child = idle_programs()
    key = key_of(child)

    async def test(watch: ProcessWatch, died: Died) -> None:
        watch.add(key)
        watch.signal(key, kind)
        assert await died.get() == key

    watching(test)
    assert child.wait(PATIENCE_S) == -number


def test_whoever_is_not_watched_or_not_surely_known_gets_no_signal(idle_programs: Programs) -> None:
    child = idle_programs()

    async def test(watch: ProcessWatch, died: Died) -> None:
        watch.signal(key_of(child), "kill")
        unsure = ProcessKey(child.pid, 0)
        watch.add(unsure)
        watch.signal(unsure, "kill")
        child.kill()
        assert await died.get() == unsure
        watch.signal(unsure, "kill")

    watching(test)
    assert child.wait(PATIENCE_S) == -signal.SIGKILL


def test_a_signal_that_comes_too_late_is_no_error(idle_programs: Programs) -> None:
    child = idle_programs()

    async def test(watch: ProcessWatch, died: Died) -> None:
        key = key_of(child)
        watch.add(key)
        child.kill()
        child.wait(PATIENCE_S)  # the loop has not heard of it yet
        watch.signal(key, "term")
        assert await died.get() == key

    watching(test)
