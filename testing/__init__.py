"""Tools for tests of programs that hold leases: a private daemon, a simulated GPU, consumers, and
assertions on what happened. `plugin` is their pytest plugin; no other module imports pytest.

    def test_the_policy_makes_room(arbiter, consumer, timeline):
        policy = consumer("policy", hold, "policy", "4GiB")
        policy.reached("held")
        consumer("detector", [sys.executable, "-m", "robot.detector"]).reached("held")
        timeline.evicted_once("policy")
        timeline.no_overcommit()

The names below are loaded when they are first used: pytest imports this package at each start.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vram_arbiter.testing.consumer import Consumer
    from vram_arbiter.testing.daemon import ArbiterProcess
    from vram_arbiter.testing.gpu import FakeGpu
    from vram_arbiter.testing.stand_in import hold
    from vram_arbiter.testing.timeline import Timeline
    from vram_arbiter.testing.waiting import eventually

__all__ = ["ArbiterProcess", "Consumer", "FakeGpu", "Timeline", "eventually", "hold"]

_HOME = {
    "ArbiterProcess": "daemon",
    "Consumer": "consumer",
    "FakeGpu": "gpu",
    "Timeline": "timeline",
    "eventually": "waiting",
    "hold": "stand_in",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value
