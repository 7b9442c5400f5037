"""Scenarios for `vramctl simulate`: GPUs, consumers with their footprints, arrivals and times. One
model, one YAML file each.

Pure: `load_scenario(text, name)` takes the text of a file. configs/scenarios holds examples with
every key explained.
"""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.units import ByteSize
from vram_arbiter.schemas.yamltext import Path, parse_yaml, validated

Seconds = Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=d.NAME_MAX_CHARS)]

JOBS_MAX = 20_000
"""Jobs of one consumer; more is a mistake in a rate."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def _span(value: object) -> object:
    return (value, value) if isinstance(value, int | float) else value


Span = Annotated[tuple[Seconds, Seconds], BeforeValidator(_span)]
"""A number of seconds, or `[least, most]` of which a number is drawn."""


class ScenarioGpu(_Part):
    """One GPU."""

    capacity: ByteSize
    """All its bytes."""
    reserve: ByteSize = d.RESERVE_BYTES
    """Never leased."""
    overhead: ByteSize = 0
    """What the driver itself shows as used."""
    release_lag_s: Seconds = 0.5
    """So much later than an unload the driver shows the bytes as free."""


class Arrivals(_Part):
    """When a consumer gets work: exactly one of the four ways."""

    at_s: Annotated[tuple[Seconds, ...], Field(max_length=JOBS_MAX)] | None = None
    """At these seconds."""
    every_s: Positive | None = None
    """At a steady rhythm."""
    per_minute: Annotated[float, Field(gt=0, le=60_000)] | None = None
    """At random, so many a minute on average (Poisson)."""
    after: Name | None = None
    """When a job of that consumer is over; `start_s` gives the first one where they wait for each
    other in a circle."""
    start_s: Seconds | None = None
    """First arrival of `every_s` and `per_minute` (default 0), or a first one before any
    `after`."""
    think_s: Span = (0.0, 0.0)
    """Pause between the other's job and this one (`after`)."""
    jitter_s: Seconds = 0.0
    """Each arrival of `every_s` is up to so much later."""
    count: Annotated[int, Field(ge=1, le=JOBS_MAX)] | None = None
    """At most so many."""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        given = [
            key
            for key in ("at_s", "every_s", "per_minute", "after")
            if getattr(self, key) is not None
        ]
        if len(given) != 1:
            raise ValueError(
                "give exactly one of at_s, every_s, per_minute and after, not "
                f"{', '.join(given) or 'none'}"
            )
        return self


class ScenarioConsumer(_Part):
    """One process with one model."""

    load_peak: ByteSize
    """Bytes at the worst moment of loading."""
    steady: ByteSize | None = None
    """Bytes when loaded. Default: load_peak."""
    residue: ByteSize = d.RESIDUE_BYTES
    """What its process keeps after unloading."""
    load_s: Span = (2.0, 2.0)
    """How long loading takes."""
    unload_s: Span = (0.03, 0.03)
    """How long unloading takes."""
    use_s: Span
    """How long one job uses the model."""
    arrivals: Arrivals
    """When there is work."""
    priority: Annotated[int, Field(ge=0, le=d.PRIORITY_MAX)] = d.PRIORITY
    """0 to 100."""
    evictable: bool = True
    """False: pinned once it is loaded."""
    exclusive: bool = False
    """No other model on its GPU."""
    min_residency_s: Seconds = d.MIN_RESIDENCY_S
    """It may stay at least so long once it is ready."""
    gpu: Name = "any"
    """Index of the GPU, or any."""
    wait_timeout_s: Positive | None = None
    """It gives up waiting after so long. Null: never."""
    idle_release_s: Seconds | None = None
    """It lets go by itself when it had no work for so long. Null: it stays until it is asked."""
    standby: bool = False
    """Asked to leave, it comes back by itself when there is room."""


class Stowaway(_Part):
    """A process that takes bytes without a lease."""

    name: Name
    bytes: ByteSize
    """How much."""
    from_s: Seconds = 0.0
    """Since when."""
    to_s: Seconds | None = None
    """Until when. Null: the end."""
    gpu: Annotated[int, Field(ge=0)] = 0
    """Index of the GPU."""


class Scenario(_Part):
    """A whole file."""

    about: str
    """One sentence for the head of the report."""
    seconds: Positive
    """How long."""
    seed: int = 0
    """Of everything that is drawn."""
    gpus: Annotated[tuple[ScenarioGpu, ...], Field(min_length=1, max_length=16)]
    consumers: Annotated[dict[Name, ScenarioConsumer], Field(min_length=1, max_length=256)]
    stowaways: tuple[Stowaway, ...] = ()

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name, consumer in self.consumers.items():
            other = consumer.arrivals.after
            if other is not None and other not in self.consumers:
                raise ValueError(f"consumers.{name}.arrivals.after: there is no consumer {other!r}")
            if consumer.gpu != "any" and not (
                consumer.gpu.isdecimal() and int(consumer.gpu) < len(self.gpus)
            ):
                raise ValueError(
                    f"consumers.{name}.gpu: {consumer.gpu!r} is not a GPU; write 0 to "
                    f"{len(self.gpus) - 1} or any"
                )
            if (consumer.steady or 0) > consumer.load_peak:
                raise ValueError(f"consumers.{name}.steady is larger than its load_peak")
        for stowaway in self.stowaways:
            if stowaway.gpu >= len(self.gpus):
                raise ValueError(
                    f"stowaways: {stowaway.name} is on GPU {stowaway.gpu}, which is not there"
                )
        return self


class _Keys(Mapping[Path, Collection[str]]):
    """Known keys by path, where paths hold names and numbers of the file's own."""

    def __init__(self, data: Any) -> None:
        self._found: dict[Path, Collection[str]] = {(): list(Scenario.model_fields)}
        if isinstance(data, dict) and isinstance(consumers := data.get("consumers"), dict):
            for name in consumers:
                self._found["consumers", name] = list(ScenarioConsumer.model_fields)
                self._found["consumers", name, "arrivals"] = list(Arrivals.model_fields)
        for key, part in (("gpus", ScenarioGpu), ("stowaways", Stowaway)):
            items = data.get(key) if isinstance(data, dict) else None
            for index in range(len(items) if isinstance(items, list) else 0):
                self._found[key, index] = list(part.model_fields)

    def __getitem__(self, path: Path) -> Collection[str]:
        return self._found[path]

    def __iter__(self) -> Any:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def load_scenario(text: str, name: str) -> Scenario:
    """Read the text of a scenario; `name` is how errors call the file.

    Raises ConfigError with every mistake, each with its line: `robot.yaml:12: consumers.grab.lod_s:
    unknown key; did you mean load_s?`
    """
    source = parse_yaml(text, name)
    return validated(Scenario, source, _Keys(source.data))
