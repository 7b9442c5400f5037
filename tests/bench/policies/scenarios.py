"""Scenarios of the comparison with other programs' rules: GPUs, consumers and their work.

Every arrival and duration is drawn beforehand, so that all schedulers get the same work. Times are
seconds since the beginning; data only.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from random import Random

from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.sizes import parse_bytes
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

type Span = tuple[float, float]
"""Seconds, drawn between least and most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Consumer:
    """One process with one model. Its work arrives in one of four ways: `at_s`, `every_s`,
    `per_minute` (Poisson), or `after` each job of another consumer."""

    load_peak: str
    steady: str = ""  # default: load_peak
    load_s: Span = (2.0, 2.0)
    use_s: Span = (1.0, 1.0)
    unload_s: float = 0.03
    priority: int = d.PRIORITY
    evictable: bool = True
    standby: bool = False
    wait_timeout_s: float | None = None
    idle_release_s: float | None = None  # it releases after so long without work
    at_s: tuple[float, ...] = ()
    every_s: float = 0.0
    per_minute: float = 0.0
    after: str = ""
    start_s: float | None = None  # of the first job
    think_s: Span = (0.0, 0.0)  # pause after the other's job
    jitter_s: float = 0.0
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Stowaway:
    """A process that takes bytes without a lease."""

    name: str
    size: str
    from_s: float = 0.0
    to_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One GPU and its consumers."""

    about: str
    seconds: float
    consumers: Mapping[str, Consumer]
    seed: int = 0
    capacity: str = "8GiB"
    overhead: str = "0B"  # shown as used by the driver itself
    release_lag_s: float = 0.5  # the driver shows freed bytes so much later
    stowaways: tuple[Stowaway, ...] = ()

    @property
    def gpu(self) -> GpuInfo:
        """The GPU as the engine is told of it."""
        return GpuInfo(GpuId("GPU-0"), 0, "GPU 0", parse_bytes(self.capacity), d.RESERVE_BYTES)


@dataclass(frozen=True, slots=True)
class Job:
    """One piece of work that needs its consumer's model resident."""

    due_s: float
    spec: LeaseSpec
    use_s: float
    load_s: float
    unload_s: float
    wait_timeout_s: float | None
    release_after_s: float | None


@dataclass(slots=True)
class Plan:
    """The jobs of one consumer in order of arrival. `followers`: plans that get their next job,
    after its pause `due_s`, when one of this plan is over."""

    consumer: str
    jobs: list[Job]
    followers: list[tuple["Plan", list[Job]]] = field(default_factory=list)


def plans_of(scenario: Scenario) -> list[Plan]:
    """Draw the work of a scenario; the same scenario always gives the same."""
    plans: dict[str, Plan] = {}
    later: dict[str, list[Job]] = {}
    for name, consumer in scenario.consumers.items():
        random = Random(f"{scenario.seed} {name}")
        due = list(_arrivals(consumer, scenario.seconds, random))[: consumer.count]
        plans[name] = Plan(name, [_job(name, consumer, due_s, random) for due_s in due])
        if consumer.after:
            quickest = min(max(0.05, one.use_s[0]) for one in scenario.consumers.values())
            most = consumer.count or 1 + int(scenario.seconds / quickest)
            pauses = (random.uniform(*consumer.think_s) for _ in range(most - len(due)))
            later[name] = [_job(name, consumer, pause_s, random) for pause_s in pauses]
    for name, jobs in later.items():
        plans[scenario.consumers[name].after].followers.append((plans[name], jobs))
    return list(plans.values())


def _arrivals(consumer: Consumer, seconds: float, random: Random) -> Iterator[float]:
    if consumer.at_s or consumer.after:
        yield from consumer.at_s
        if consumer.after and consumer.start_s is not None:
            yield consumer.start_s
        return
    now = consumer.start_s or 0.0
    while now < seconds:
        yield now + (random.uniform(0.0, consumer.jitter_s) if consumer.jitter_s else 0.0)
        now += consumer.every_s or random.expovariate(consumer.per_minute / 60)


def _job(name: str, consumer: Consumer, due_s: float, random: Random) -> Job:
    peak = parse_bytes(consumer.load_peak)
    steady = parse_bytes(consumer.steady) if consumer.steady else peak
    spec = LeaseSpec(
        consumer=name,
        model_id=name,
        footprint=Footprint(peak, steady),
        priority=consumer.priority,
        evictable=consumer.evictable,
        standby=consumer.standby,
    )
    use_s, load_s = random.uniform(*consumer.use_s), random.uniform(*consumer.load_s)
    waits = (consumer.wait_timeout_s, consumer.idle_release_s)
    return Job(due_s, spec, use_s, load_s, consumer.unload_s, *waits)


SCENARIOS: Mapping[str, Scenario] = {
    "find-navigate-grab": Scenario(
        about="find, navigate, grab, look again: the detector fits beside neither of the others",
        seconds=600,
        seed=1,
        overhead="100MiB",
        release_lag_s=0.7,
        consumers={
            "detector": Consumer(
                load_peak="5.3GB", steady="4.9GB", load_s=(2.2, 2.8), use_s=(0.2, 0.4),
                after="look", think_s=(1, 4), start_s=0,
            ),
            "grab": Consumer(
                load_peak="4.3GB", steady="4.1GB", load_s=(1.8, 2.2), use_s=(12, 20),
                priority=60, after="detector", think_s=(6, 15),
            ),
            "look": Consumer(
                load_peak="3.3GB", steady="3.0GB", load_s=(1.4, 1.8), use_s=(0.6, 1.2),
                after="grab", think_s=(0.1, 0.3),
            ),
        },
    ),
    "small-behind-large": Scenario(
        about="a long job, a large model that waits for it, and small ones that fit beside it",
        seconds=600,
        seed=4,
        consumers={
            "long": Consumer(load_peak="4GiB", use_s=(40, 60), every_s=120),
            "large": Consumer(
                load_peak="6GiB", load_s=(3, 3), use_s=(2, 5), priority=60, every_s=60, start_s=10
            ),
            "small": Consumer(
                load_peak="1GiB", load_s=(0.5, 0.5), use_s=(0.2, 0.5), idle_release_s=1,
                every_s=5, jitter_s=2, start_s=5,
            ),
        },
    ),
    "two-thrashing": Scenario(
        about="two models of 5 GiB on 8 GiB, each asked every other second",
        seconds=600,
        seed=2,
        consumers={
            "left": Consumer(load_peak="5GiB", use_s=(0.3, 0.3), every_s=2, jitter_s=0.5),
            "right": Consumer(
                load_peak="5GiB", use_s=(0.3, 0.3), every_s=2, jitter_s=0.5, start_s=1
            ),
        },
    ),
    "desktop": Scenario(
        about="model servers on a desktop's 12 GB GPU, with a browser that takes its share",
        seconds=1800,
        seed=3,
        capacity="12GiB",
        overhead="250MiB",
        release_lag_s=0.8,
        consumers={
            "chat": Consumer(
                load_peak="6.5GiB", steady="6GiB", load_s=(4, 6), use_s=(3, 20), priority=60,
                per_minute=1.5,
            ),
            "coder": Consumer(
                load_peak="8.5GiB", steady="8GiB", load_s=(6, 8), use_s=(5, 30), per_minute=0.5
            ),
            "embedder": Consumer(
                load_peak="1GiB", load_s=(0.8, 0.8), use_s=(0.05, 0.2), per_minute=20
            ),
            "image": Consumer(
                load_peak="7GiB", steady="5GiB", load_s=(5, 7), use_s=(10, 40), priority=40,
                per_minute=0.25,
            ),
        },
        stowaways=(
            Stowaway("browser", "900MiB"),
            Stowaway("video call", "700MiB", 600, 1200),
        ),
    ),
}  # fmt: skip
