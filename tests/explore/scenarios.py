"""The worlds that are explored, small ones first. Each says in its name what it is about."""

from collections.abc import Mapping
from typing import Any

from tests.explore.world import FOR_EVER_S, Scenario
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


def kind(
    name: str, peak_bytes: int, steady_bytes: int = 0, residue_bytes: int = 0, **spec: Any
) -> LeaseSpec:
    """Return what clients of a kind ask for; no residency, and a time to live that never ends."""
    sizes = Footprint(peak_bytes, steady_bytes or peak_bytes, residue_bytes)
    usual = {"ttl_s": FOR_EVER_S, "min_residency_s": 0.0}
    return LeaseSpec(consumer=name, model_id=name, footprint=sizes, **(usual | spec))


BIG = kind("big", 5 * GIB)
SMALL = kind("small", 3 * GIB)
PEAKY = kind("peaky", 6 * GIB, 3 * GIB, 450 * MIB)
URGENT = kind("urgent", 5 * GIB, priority=60)
ALONE = kind("alone", 3 * GIB, mode="exclusive")
RETURNS = kind("returns", 5 * GIB, standby=True)
STAYS = kind("stays", 3 * GIB, evictable=False)
TALKS = kind("talks", 5 * GIB, ttl_s=12.0)

_LIES = {"lie less": 1, "lie more": 1, "lie nonsense": 1}
_ALL = (
    Scenario("turns", (BIG, BIG)),
    Scenario("uses", (BIG, BIG), borrows=True),
    Scenario("cancel", (BIG, BIG), faults={"cancel": 1}, acquires=2),
    Scenario("timeout", (BIG, BIG), wait_timeout_s=3.0),
    Scenario("readings", (BIG, BIG), faults={"late": 1, "fail": 1, **_LIES}),
    Scenario("stranger", (BIG, PEAKY), faults={"stranger": 2}),
    Scenario("suspend", (BIG, BIG), faults={"suspend": 1}),
    Scenario("bye", (BIG, BIG), faults={"bye": 1}),
    Scenario("standby", (RETURNS, BIG), acquires=2),
    Scenario("stays", (STAYS, ALONE)),
    Scenario("operator", (BIG, BIG), faults={"evict": 1, "kill": 1}),
    Scenario("crash", (BIG, PEAKY), faults={"crash": 1, "late": 1}, lags=True),
    Scenario("restart", (BIG, PEAKY), faults={"restart": 1, "crash": 1}),
    Scenario("disk", (BIG, BIG), faults={"full": 1, "restart": 1}),
    Scenario("blind", (BIG, PEAKY), faults={"fail": 1}, lists=False, lags=True),
    Scenario("talk", (TALKS,), faults={"drop": 2}, talks=True),
    Scenario("talk-turns", (TALKS, TALKS), faults={"drop": 1}, talks=True),
    Scenario("talk-restart", (TALKS, TALKS), faults={"restart": 1, "late": 1}, talks=True),
    Scenario("three", (BIG, BIG, BIG), faults={"cancel": 1}),
    Scenario("kinds", (BIG, PEAKY, ALONE), faults={"crash": 1}),
    Scenario("two-gpus", (BIG, BIG, BIG), gpus=2),
    Scenario("borrowed", (BIG, URGENT, SMALL), gpus=2, borrows=True, faults={"crash": 1}),
    Scenario(
        "everything",
        (BIG, PEAKY, URGENT),
        gpus=2,
        acquires=2,
        faults={"crash": 1, "restart": 1, "late": 1, "fail": 1, "cancel": 1, **_LIES},
    ),
)
SCENARIOS: Mapping[str, Scenario] = {one.name: one for one in _ALL}
