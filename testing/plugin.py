"""Pytest plugin: fixtures with a private daemon and its simulated GPU, and reports of failed tests
with what happened there.

Pytest imports it at each start, so it imports nothing else of the kit before a fixture needs it.
"""

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from vram_arbiter.testing.consumer import Consumer
    from vram_arbiter.testing.daemon import ArbiterProcess
    from vram_arbiter.testing.gpu import FakeGpu
    from vram_arbiter.testing.timeline import Timeline

type Make = Callable[..., ArbiterProcess]
type Start = Callable[..., Consumer]
MARKER = "gpu_budget"
_SHOWN = pytest.StashKey[list[tuple[str, Callable[[], str]]]]()
"""Sections of the report of a failed test: title, and what makes its text."""


def gpu_budget(
    size: str = "8GiB", lag: str = "500ms", config: str | None = None
) -> tuple[int, float, str | None]:
    """Return the marker's arguments as bytes, seconds and text. Raises ValueError, and TypeError
    for others."""
    from vram_arbiter.schemas.sizes import parse_bytes
    from vram_arbiter.testing.waiting import parse_lag

    return parse_bytes(size), parse_lag(lag), config


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        f'{MARKER}(size="8GiB", lag="500ms", config=None): the simulated GPU of fixture `arbiter`; '
        "how late memory is free again; text of an arbiter.yaml",
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the timelines and outputs to the report of a failed test."""
    report = yield
    if report.failed and report.when != "teardown":
        report.sections += [(title, _read(text)) for title, text in item.stash.get(_SHOWN, ())]
    return report


def _read(text: Callable[[], str]) -> str:
    try:
        return text()
    except (OSError, ValueError) as error:  # the test itself closed the daemon or the consumer
        return f"cannot be read: {error}"


def _timeline(arbiter: "ArbiterProcess") -> "Timeline":
    from vram_arbiter.testing.timeline import Timeline

    return Timeline(arbiter)


def _show(request: pytest.FixtureRequest, title: str, text: Callable[[], str]) -> None:
    request.node.stash.setdefault(_SHOWN, []).append((title, text))


@pytest.fixture(scope="session")
def arbiter_process() -> Make:
    """What makes the daemons of `make_arbiter`; override it to start them in another way."""
    from vram_arbiter.testing.daemon import ArbiterProcess

    return ArbiterProcess


@pytest.fixture
def make_arbiter(request: pytest.FixtureRequest, arbiter_process: Make) -> Iterator[Make]:
    """`make_arbiter(gpu="fake:8GiB", arguments=(), config=None)` prepares a daemon; call `.start()`
    on it. Ended at teardown."""

    def make(*arguments: Any, **named: Any) -> "ArbiterProcess":
        daemon = ends.enter_context(closing(arbiter_process(*arguments, **named)))
        _show(request, "timeline of the arbiter", lambda: _timeline(daemon).text())
        _show(request, "log of the arbiter", lambda: daemon.log)
        return daemon

    with ExitStack() as ends:
        yield make


@pytest.fixture
def arbiter(request: pytest.FixtureRequest, make_arbiter: Make) -> "ArbiterProcess":
    """A running daemon with the simulated GPU of marker `gpu_budget`."""
    mark = request.node.get_closest_marker(MARKER)
    try:
        size, lag_s, config = gpu_budget(*mark.args, **mark.kwargs) if mark else gpu_budget()
    except (TypeError, ValueError) as error:
        pytest.fail(f"@pytest.mark.{MARKER}: {error}", pytrace=False)
    daemon = make_arbiter(f"fake:{size}", config=config)
    daemon.spawn()
    from vram_arbiter.testing.gpu import FakeGpu  # takes as long as the daemon's start

    daemon.wait_for("READY=1")
    FakeGpu(daemon.gpu_folder).edit(release_lag_s=lag_s)
    return daemon


@pytest.fixture
def fake_gpu(arbiter: "ArbiterProcess") -> "FakeGpu":
    """The simulated GPU of `arbiter`: bytes by hand, and faults."""
    from vram_arbiter.testing.gpu import FakeGpu

    return FakeGpu(arbiter.gpu_folder)


@pytest.fixture
def consumer(request: pytest.FixtureRequest, arbiter: "ArbiterProcess") -> Iterator[Start]:
    """`consumer(name, program, *arguments)` starts a command, or a function of the test's file, in
    a process of its own. Ended at teardown."""
    from vram_arbiter.testing.consumer import Consumer

    def start(name: str, program: Any, *arguments: Any, **named: Any) -> "Consumer":
        begun = ends.enter_context(closing(Consumer(arbiter, name, program, *arguments, **named)))
        _show(request, f"output of {name}", lambda: begun.output)
        return begun

    with ExitStack() as ends:
        yield start


@pytest.fixture
def timeline(arbiter: "ArbiterProcess") -> "Timeline":
    """What happened: events, and assertions on them."""
    return _timeline(arbiter)


@pytest.fixture(scope="session")
def eventually() -> Callable[..., Any]:
    """`eventually(condition, within_s=60.0)` polls until the condition is true."""
    from vram_arbiter.testing.waiting import eventually

    return eventually
