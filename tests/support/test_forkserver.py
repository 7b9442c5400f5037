"""Forked children: they say, are told, die alone, and a defect of theirs is seen."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.forkserver import Child, ForkServer

PROGRAM = """
import json, os, sys
def say(event, **facts):
    print(json.dumps({"event": event, **facts}), flush=True)
def main(arguments):
    say("born", arguments=list(arguments), word=os.environ.get("WORD"), parent=os.getppid())
    for line in sys.stdin:
        if line.strip() == "fail":
            raise ValueError("on purpose")
        say("heard", line=line.strip())
    say("end")
"""


@pytest.fixture
def forks(tmp_path: Path) -> Iterator[ForkServer]:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    with ForkServer(program, os.environ, tmp_path / "errors.log") as server:
        yield server


@pytest.fixture
def child(forks: ForkServer) -> Iterator[Child]:
    child = forks.spawn("one", "two", WORD="hello")
    yield child
    child.close()


def test_a_child_has_its_arguments_its_environment_and_its_own_pipes(
    forks: ForkServer, child: Child
) -> None:
    born = child.until("born")
    assert (born["arguments"], born["word"], born["parent"]) == (["one", "two"], "hello", forks.pid)
    other = forks.spawn("other")
    other.tell("to other")
    child.tell("to child")
    assert other.until("heard")["line"] == "to other"
    assert child.until("heard")["line"] == "to child"
    other.close()


def test_it_ends_with_its_input_and_its_end_is_seen(child: Child) -> None:
    child.until("born")
    assert child.alive
    child.hang_up()
    child.until("end")
    child.wait()
    assert not child.alive
    child.tell("nobody listens")
    child.signal(signal.SIGTERM)


def test_a_killed_child_says_nothing_more(child: Child) -> None:
    child.until("born")
    child.kill()
    with pytest.raises(AssertionError, match="ended before it said 'end'"):
        child.until("end")


def test_a_defect_ends_the_child_alone(forks: ForkServer, child: Child, tmp_path: Path) -> None:
    child.until("born")
    child.tell("fail")
    child.wait()
    assert "ValueError: on purpose" in (tmp_path / "errors.log").read_text()
    other = forks.spawn("still")
    assert other.until("born")["arguments"] == ["still"]
    other.close()
