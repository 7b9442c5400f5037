"""A scenario as a workload.

Every arrival and every duration is drawn beforehand, so that all policies get the same work.
"""

from collections.abc import Iterator
from random import Random

from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.lab.workload import Follower, GpuPlan, Job, Plan, Workload
from vram_arbiter.schemas.config.scenario import JOBS_MAX, Scenario, ScenarioConsumer
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


def settings_of(scenario: Scenario) -> Settings:
    """Settings of the engine with its default constants."""
    return Settings(epoch=1, gpus=tuple(gpu.info for gpu in workload_of(scenario).gpus))


def workload_of(scenario: Scenario) -> Workload:
    """Return the workload of a scenario; the same scenario always gives the same one."""
    gpus = [
        GpuPlan(
            GpuInfo(GpuId(f"GPU-{index}"), index, f"GPU {index}", gpu.capacity, gpu.reserve),
            gpu.capacity,
            gpu.overhead,
            gpu.release_lag_s,
            tuple(_others(scenario, index)),
        )
        for index, gpu in enumerate(scenario.gpus)
    ]
    plans: dict[str, Plan] = {}
    later: dict[str, list[Job]] = {}
    for name, consumer in scenario.consumers.items():
        random = Random(f"{scenario.seed} {name}")
        jobs = [
            _job(name, consumer, due_s, random)
            for due_s in _arrivals(consumer, scenario.seconds, random)
        ]
        plans[name] = Plan(name, jobs)
        if consumer.arrivals.after is not None:
            most = consumer.arrivals.count or _most(scenario)
            later[name] = [
                _job(name, consumer, random.uniform(*consumer.arrivals.think_s), random)
                for _ in range(most - len(jobs))
            ]
    for name, jobs in later.items():
        after = scenario.consumers[name].arrivals.after
        plans[str(after)].followers.append(Follower(plans[name], jobs))
    return Workload(gpus, list(plans.values()), scenario.seconds)


def _most(scenario: Scenario) -> int:
    """Most jobs of a chain; more do not fit into the time."""
    quickest = min(max(0.05, consumer.use_s[0]) for consumer in scenario.consumers.values())
    return min(JOBS_MAX, 1 + int(scenario.seconds / quickest))


def _others(scenario: Scenario, index: int) -> Iterator[tuple[float, str, int]]:
    for stowaway in scenario.stowaways:
        if stowaway.gpu == index:
            yield stowaway.from_s, stowaway.name, stowaway.bytes
            if stowaway.to_s is not None:
                yield stowaway.to_s, stowaway.name, 0


def _arrivals(consumer: ScenarioConsumer, seconds: float, random: Random) -> list[float]:
    when = consumer.arrivals
    if when.at_s is not None:
        times = sorted(when.at_s)
    elif when.after is not None:
        times = [] if when.start_s is None else [when.start_s]
    else:
        times = []
        now = when.start_s or 0.0
        while now < seconds and len(times) < min(JOBS_MAX, when.count or JOBS_MAX):
            times.append(now + (random.uniform(0.0, when.jitter_s) if when.jitter_s else 0.0))
            now += (
                when.every_s
                if when.every_s is not None
                else random.expovariate((when.per_minute or 1.0) / 60)
            )
    return times[: when.count]


def _job(name: str, consumer: ScenarioConsumer, due_s: float, random: Random) -> Job:
    steady = consumer.load_peak if consumer.steady is None else consumer.steady
    spec = LeaseSpec(
        consumer=name,
        model_id=name,
        gpu=consumer.gpu,
        mode="exclusive" if consumer.exclusive else "shared",
        footprint=Footprint(consumer.load_peak, steady, consumer.residue),
        priority=consumer.priority,
        evictable=consumer.evictable,
        min_residency_s=consumer.min_residency_s,
        standby=consumer.standby,
    )
    return Job(
        due_s,
        spec,
        use_s=random.uniform(*consumer.use_s),
        load_s=random.uniform(*consumer.load_s),
        unload_s=random.uniform(*consumer.unload_s),
        wait_timeout_s=consumer.wait_timeout_s,
        release_after_s=consumer.idle_release_s,
    )
