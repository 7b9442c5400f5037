"""The worlds that are explored, small ones first. Each says in its name what it is about."""

from collections.abc import Mapping
from typing import Any

from tests.explore.world import FOR_EVER_S, Scenario
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


def kind(name: str, peak: int, steady: int = 0, residue: int = 0, **spec: Any) -> LeaseSpec:
    """Return what clients of a kind ask for, in bytes: no residency, a time to live without end."""
    usual = {"ttl_s": FOR_EVER_S, "min_residency_s": 0.0}
    sizes = Footprint(peak, steady or peak, residue)
    return LeaseSpec(consumer=name, model_id=name, footprint=sizes, **(usual | spec))


BIG, HALF = kind("big", 5 * GIB), kind("half", 3 * GIB)
PEAKY = kind("peaky", 6 * GIB, 3 * GIB, 450 * MIB)
URGENT = kind("urgent", 5 * GIB, priority=60)
ALONE = kind("alone", 3 * GIB, mode="exclusive")
RETURNS = kind("returns", 5 * GIB, standby=True)
STAYS = kind("stays", 3 * GIB, evictable=False)
TALKS = kind("talks", 5 * GIB, ttl_s=12.0)
BACK = kind("talks back", 5 * GIB, ttl_s=12.0, standby=True)
EVERYTHING = {"crash": 1, "restart": 1, "late": 1, "fail": 1, "cancel": 1, "lie": 1}
HELD = "acquire a, send a, hear a, load a, ready a, send a, hear a"
REVOKED = f"{HELD}, acquire b, send b"
"""One client holds, another one waits, and neither has heard of it."""
EVICTED = "acquire a, load a, ready a, read GPU-0, acquire b"
"""One client is asked to leave for another one."""


def evicted(fault: str) -> Scenario:
    """Return the world in which one fault happens during an eviction."""
    how: Mapping[str, Any] = {"acquires": 2, "after": EVICTED, "lags": True}
    return Scenario(f"evicted-{fault}", (BIG, PEAKY), faults={fault: 1}, **how)


def revoked(fault: str) -> Scenario:
    """Return the world in which one fault happens while the clients hear of an eviction."""
    how: Mapping[str, Any] = {"after": REVOKED, "talks": True}
    return Scenario(f"revoked-{fault}", (BACK, TALKS), faults={fault: 1}, **how)


SCENARIOS: Mapping[str, Scenario] = {
    one.name: one
    for one in (
        Scenario("turns", (BIG, BIG)),
        Scenario("timeout", (BIG, BIG), wait_timeout_s=3.0),
        Scenario("cancel", (BIG, BIG), acquires=2, faults={"cancel": 1}),
        Scenario("stays", (STAYS, ALONE), faults={"cancel": 1}),
        Scenario("standby", (RETURNS, BIG), acquires=2),
        Scenario("restart", (BIG, PEAKY), faults={"restart": 1, "crash": 1}),
        Scenario("readings", (BIG, BIG), faults={"late": 1, "fail": 1, "lie": 1}),
        *map(evicted, ("crash", "late", "fail", "lie", "restart", "cancel")),
        Scenario("blind", (HALF, HALF), acquires=2, lists=False, lags=True),
        Scenario("talk", (TALKS,), faults={"drop": 2}, talks=True),
        Scenario("talk-turns", (TALKS, TALKS), faults={"drop": 1}, talks=True),
        Scenario("talk-restart", (TALKS, TALKS), faults={"restart": 1, "late": 1}, talks=True),
        Scenario(
            "talk-timeout", (TALKS, TALKS), wait_timeout_s=3.0, faults={"drop": 1}, talks=True
        ),
        *map(revoked, ("drop", "cancel", "crash", "restart")),
        Scenario("three", (BIG, BIG, BIG)),
        Scenario("kinds", (BIG, PEAKY, ALONE), faults={"crash": 1}),
        Scenario("two-gpus", (BIG, BIG, BIG), gpus=2),
        Scenario("placed", (BIG, URGENT, HALF), gpus=2, faults={"crash": 1, "cancel": 1}),
        Scenario("everything", (BIG, PEAKY, URGENT), gpus=2, acquires=2, faults=EVERYTHING),
    )
}
