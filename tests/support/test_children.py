"""Forked children: they say, are told, die alone, and a defect of theirs is seen."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.children import Child, spawn
from tests.support.process import ArbiterProcess

pytestmark = pytest.mark.e2e


@pytest.fixture
def child(arbiter_daemon: ArbiterProcess, tmp_path: Path) -> Iterator[Child]:
    errors, environ = tmp_path / "errors.log", arbiter_daemon.environ
    arguments = ("one", "1000", str(arbiter_daemon.gpu_folder), "0")
    child = spawn("stepper", *arguments, name="one", environ=environ, errors=errors)
    yield child
    child.close()


def test_it_says_and_is_told_and_its_end_is_seen(child: Child) -> None:
    child.until("waiting")
    child.until("loading")
    child.tell("go")
    child.until("ready")
    assert child.alive
    child.kill()
    assert not child.alive
    with pytest.raises(AssertionError, match="ended before it said 'released'"):
        child.until("released")
    child.hang_up()
    child.tell("nobody listens")
    child.signal(signal.SIGTERM)


def test_a_defect_ends_it_and_is_written_down(tmp_path: Path) -> None:
    errors = tmp_path / "errors.log"
    child = spawn("stepper", "too few", name="one", environ=os.environ, errors=errors)
    child.wait()
    child.close()
    assert "ValueError: not enough values" in errors.read_text()
