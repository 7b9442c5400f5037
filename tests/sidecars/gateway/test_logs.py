"""Logs of servers, and readers that follow them."""

import pytest

from vram_arbiter.sidecars.gateway.logs import BEHIND_MAX_BYTES, LINE_MAX_BYTES, Log, following

pytestmark = pytest.mark.anyio


async def test_a_reader_gets_what_is_printed_from_then_on() -> None:
    log, other = Log("a"), Log("b")
    log.add(b"before")
    with following([log, other]) as reader:
        log.add(b"one\x1b[2J")
        other.add(b"two")
        first, second = (await reader.take()).decode().splitlines()
        assert first.startswith("a: one")
        assert "\x1b" not in first
        assert second == "b: two"
    assert not log.readers
    assert log.text().startswith("a: before\n")


async def test_a_reader_that_falls_behind_gets_whole_lines_and_then_none() -> None:
    log = Log("a")
    line = b"x" * LINE_MAX_BYTES
    with following([log]) as reader:
        while not reader.late:
            log.add(line)
        log.add(b"lost")
        taken = await reader.take()
    assert BEHIND_MAX_BYTES - 2 * len(line) < len(taken) <= BEHIND_MAX_BYTES
    assert taken.endswith(line + b"\n")
