"""Scenario files: consumers on a private daemon, and steps with what is expected of them.

`load_scenario(text, name)` takes the text of a file; `play(scenario)` performs it.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing
from signal import SIGKILL
from subprocess import TimeoutExpired
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from vram_arbiter.clients.cli.status import all_pages
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.fakegpu import RELEASE_LAG_S
from vram_arbiter.schemas.findings import Problem, did_you_mean, raise_if
from vram_arbiter.schemas.units import ByteSize
from vram_arbiter.schemas.yamltext import parse_yaml, validated
from vram_arbiter.testing.consumer import Consumer
from vram_arbiter.testing.daemon import ArbiterProcess
from vram_arbiter.testing.gpu import FakeGpu
from vram_arbiter.testing.stand_in import hold
from vram_arbiter.testing.timeline import Timeline
from vram_arbiter.testing.waiting import eventually, parse_lag

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Size = Annotated[ByteSize, Field(gt=0)]
State = Literal[
    "queued", "loading", "held", "revoking", "unloading", "verifying", "standby", "parked", "gone"
]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Holder(_Section):
    """A consumer: what its lease asks for."""

    vram: Size
    """Bytes that it puts on the GPU."""
    priority: Annotated[int, Field(ge=0, le=d.PRIORITY_MAX)] = d.PRIORITY
    standby: bool = False
    """Evicted, it returns by itself."""


class Step(_Section):
    """One action or expectation: exactly one of its keys."""

    start: Name | None = None
    """Starts a consumer."""
    use: Name | None = None
    """Begins a use on its lease."""
    idle: Name | None = None
    """Ends the use."""
    stop: Name | None = None
    """Lets a consumer release its lease and end."""
    kill: Name | None = None
    """Ends its process by SIGKILL."""
    stowaway: Size | None = None
    """Puts bytes on the GPU by a process without a lease."""
    expect: dict[Name, State] | None = None
    """Waits until the consumers' leases have these states."""
    evicted_once: Name | None = None
    """Fails unless a consumer was evicted once."""
    granted_before: tuple[Name, Name] | None = None
    """Fails unless the first consumer was granted before the second."""

    @property
    def action(self) -> tuple[str, Any]:
        """The key and its value."""
        ((key, value),) = self.model_dump(exclude_none=True).items()
        return key, value

    @property
    def consumers(self) -> Iterable[str]:
        """Names of consumers in it."""
        _, value = self.action
        return () if self.stowaway else (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _one(self) -> Self:
        if len(self.model_dump(exclude_none=True)) != 1:
            raise ValueError(f"expected one of {', '.join(Step.model_fields)}")
        return self


class Scenario(_Section):
    """A scenario file."""

    gpu: Size
    """Memory of the simulated GPU."""
    lag: Annotated[float, BeforeValidator(parse_lag)] = RELEASE_LAG_S
    """How late given-up memory is free again: 500ms."""
    within_s: Annotated[float, Field(gt=0, le=3600)] = 20.0
    """Limit of each expectation."""
    consumers: Annotated[dict[Name, Holder], Field(min_length=1)]
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _known(self) -> Self:
        problems, started = [], set[str]()
        for at, step in enumerate(self.steps):
            known = self.consumers if step.start else started
            problems += [
                Problem(("steps", at), f"no consumer {name!r} here{did_you_mean(name, known)}")
                for name in step.consumers
                if name not in known
            ]
            started.update(step.consumers)
        raise_if(problems)
        return self


def load_scenario(text: str, name: str) -> Scenario:
    """Raises ConfigError with every mistake and its line."""
    return validated(Scenario, parse_yaml(text, name))


def play(scenario: Scenario) -> tuple[str, str]:
    """Perform a scenario on a private daemon. Return what failed, empty if nothing did, and the
    timeline with what consumers printed."""
    with ExitStack() as undo:
        player = _Player(scenario, undo)
        return player.problem(), player.told()


class _Player:
    """One performance."""

    def __init__(self, scenario: Scenario, undo: ExitStack) -> None:
        self.scenario, self.undo = scenario, undo
        self.consumers: dict[str, Consumer] = {}
        self._arbiter = undo.enter_context(closing(ArbiterProcess(f"fake:{scenario.gpu}"))).start()
        self.gpu = FakeGpu(self._arbiter.gpu_folder)
        self.gpu.edit(release_lag_s=scenario.lag)
        self.timeline = Timeline(self._arbiter)

    def problem(self) -> str:
        """Perform all steps; return what failed."""
        doing = ""
        try:
            for number, step in enumerate(self.scenario.steps, 1):
                key, value = step.action
                doing = f"step {number}, {key}: {value}"
                _ACTIONS[key](self, value)
            self.timeline.no_overcommit()
        except (AssertionError, RuntimeError, VramError, TimeoutExpired) as error:
            return f"{doing}: {error}"
        return ""

    def told(self) -> str:
        outputs = [f"{name}: {one.output}" for name, one in self.consumers.items() if one.output]
        return "\n".join([self.timeline.text(), *outputs])

    def start(self, name: str) -> None:
        wanted = self.scenario.consumers[name].model_dump() | {"min_residency_s": 0.0}
        begun = Consumer(self._arbiter, name, hold, name, **wanted)
        self.consumers[name] = self.undo.enter_context(closing(begun))

    def tell(self, name: str, word: str, uses: int) -> None:
        """Tell a consumer to begin or end its use, and wait until it has `uses`."""
        consumer = self.consumers[name]
        consumer.tell(word)
        eventually(lambda: getattr(consumer.lease, "uses", 0) == uses, self.scenario.within_s)

    def stowaway(self, size: int) -> None:
        """Put bytes there, and wait until the daemon knows: a reading from before would grant."""
        self.undo.enter_context(self.gpu.stowaway(size))
        endpoint = self._arbiter.endpoint
        eventually(lambda: all_pages(endpoint)["gpus"][0]["stowaway_bytes"] >= size)

    def expect(self, states: Mapping[str, str]) -> None:
        for name, state in states.items():
            self.consumers[name].reached(state, self.scenario.within_s)


_ACTIONS: Final[Mapping[str, Callable[[_Player, Any], object]]] = {
    "start": _Player.start,
    "use": lambda player, name: player.tell(name, "use", 1),
    "idle": lambda player, name: player.tell(name, "idle", 0),
    "stop": lambda player, name: player.consumers[name].wait(player.scenario.within_s),
    "kill": lambda player, name: player.consumers[name].stop(SIGKILL),
    "stowaway": _Player.stowaway,
    "expect": _Player.expect,
    "evicted_once": lambda player, name: player.timeline.evicted_once(name),
    "granted_before": lambda player, names: player.timeline.granted_before(*names),
}
"""By the key of a step."""
