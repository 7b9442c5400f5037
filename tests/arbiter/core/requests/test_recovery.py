"""A restart of the daemon alone: what the journal names stays charged, holders come back, and
nobody is granted before."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.engine_state import state_of
from tests.support.scenes import give_back
from vram_arbiter.arbiter.core.effects import Push
from vram_arbiter.arbiter.core.events import (
    Asked,
    ClientConnected,
    ClientLeft,
    MemorySampled,
    Recovered,
)
from vram_arbiter.arbiter.core.model.lease import (
    Departure,
    Lease,
    LeaseState,
    Observed,
    Request,
    Standby,
    Use,
)
from vram_arbiter.arbiter.host.records import records_of
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, Token, UseId
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.requests import UseBegin


def held_with_token(
    driver: CoreDriver, name: str, gib: float, **spec: Any
) -> tuple[Consumer, LeaseId, Token]:
    person = driver.consumer(name)
    lease = person.acquire(int(gib * GIB), **spec)
    driver.until(lambda: driver.state(lease) == "loading")
    token = person.token(lease)
    person.load(lease)
    driver.advance(0.01)
    return person, lease, token


def loads(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    """It has not said that it is ready."""


def is_used(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.load(lease, 3 * GIB)
    det.use_begin(lease, "own")
    driver.consumer("runner", pid=7).use_begin(lease, "goal", det.token(lease), "grab")
    driver.consumer("ops").order("pin", lease)


def is_revoked(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    det.load(lease)
    driver.consumer("w").acquire(5 * GIB)


def unloads(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    is_revoked(driver, det, lease)
    det.unloading(lease)


def exits(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    unloads(driver, det, lease)
    driver.device.silent = True
    det.release(lease, exiting=True)


def parks(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    is_revoked(driver, det, lease)
    det.unload(lease, parked=True)


RUNNER = ProcessKey(7, 49)
USES = {(RUNNER, UseId("goal")): Use(UseId("goal"), ClientId(""), RUNNER, "grab", 0.0)}
PINNED = {"uses": USES, "pinned": Order("ops", "test"), "observed": Observed(3 * GIB)}
REVOKED = {"departure": Departure(revoked_before=True), "standby": Standby("w")}
EXITS = {"departure": Departure(exiting=True), "standby": Standby("w")}
PARKED = {"gpu": None, "standby": Standby("w", comes_back=True, parks=True)}


@pytest.mark.parametrize(
    ("bring", "state", "fields", "timers", "parked_bytes"),
    [
        (loads, "loading", {}, {"ttl": 15.0}, 0),
        (is_used, "held", PINNED, {"ttl": 15.0, "users": 15.0}, 0),
        (is_revoked, "held", REVOKED, {"ttl": 15.0}, 4 * GIB),
        (unloads, "held", REVOKED, {"ttl": 15.0}, 4 * GIB),
        (exits, "verifying", EXITS, {"away": 15.0}, 0),
        (parks, "parked", PARKED, {"away": 15.0}, 4 * GIB),
    ],
)
def test_a_restart_finds_a_lease_as_the_journal_has_it(
    bring: Callable[[CoreDriver, Consumer, LeaseId], None],
    state: str,
    fields: dict[str, Any],
    timers: dict[str, float],
    parked_bytes: int,
) -> None:
    """`timers`: seconds from the restart, the time to live or a silent holder's, and the grace."""
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 8 * GIB})
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, 4 * GIB, standby=True, park_bytes=4 * GIB, ttl_s=10.0)
    driver.advance(1.0)
    bring(driver, det, lease)
    driver.advance(1.0)
    before = driver.arbiter.inspect().leases[lease]
    driver.restart(start=False)
    core, now = state_of(driver.arbiter), driver.now
    request = Request("n1", now, 1, 5 * GIB, 4 * GIB, (GpuId("GPU-0"),))
    found = Lease(
        lease,
        before.spec,
        det.process,
        ClientId(""),
        request,
        state=LeaseState(state),
        token=before.token,
        gpu=GpuId("GPU-0"),
        granted_at=now,
        held_from=before.held_from,
        ready_at=now,
        expires_at=now + timers.get("ttl", -now),
        attached=False,
        story=[(now, LeaseState(state), "recovered")],
    )
    uses = {key: replace(use, began_at=now) for key, use in fields.get("uses", {}).items()}
    standby = replace(fields.get("standby", Standby()), since=now)
    assert core.leases[lease] == replace(found, **{**fields, "uses": uses, "standby": standby})
    set_for = {kind: at - now for (kind, of), at in core.timers.items() if of == lease}
    assert set_for == pytest.approx(timers)
    assert (lease in core.recovering) == ("ttl" in timers)
    assert core.host_ram.booked.get(lease, 0) == parked_bytes
    assert core.nonces[det.process, "n1"] == lease


def test_re_attaching_to_a_daemon_that_did_not_restart_only_moves_the_connection() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, token = held_with_token(driver, "det", 5)
    det.use_begin(lease, "over")
    det.use_begin(lease, "runs")
    det.client = ClientId(
        "c-new"
    )  # the same instance: the server never says that its old connection is gone
    driver.post(ClientConnected(det.client, det.process, 1000, det.name, "det-c101"))
    assert answer(det.reattach(lease, token, uses=["runs"]))["leases"][0]["lease"]["uses"] == 1
    det.use_end(lease, "runs")
    det.unloading(lease)
    assert answer(det.reattach(lease, token, uses=["late"]))["leases"][0]["lease"]["uses"] == 0, (
        "it unloads"
    )
    give_back(driver, det, lease)
    (gone,) = answer(det.reattach(lease, token))["leases"]
    assert gone["error"]["code"] == "bad_state"


def test_a_re_attachment_keeps_the_uses_that_others_began_again_before_it() -> None:
    """Regression: after a restart the users may be back before the holder, whose list knows only
    its own uses."""
    driver = CoreDriver(8 * GIB)
    det, lease, token = held_with_token(driver, "det", 5)
    runner = driver.consumer("runner")
    driver.restart()
    second = ClientId("second")  # another connection of the holder's process
    driver.post(ClientConnected(second, det.process, 1000, "det", "det-second"))
    sibling = UseBegin(lease, token, UseId("sibling"))
    driver.post(Asked(second, driver.next_request(), sibling))
    runner.connect()
    runner.use_begin(lease, "goal", token)
    det.connect()
    assert answer(det.reattach(lease, token, uses=["own"]))["leases"][0]["lease"]["uses"] == 3
    assert answer(det.reattach(lease, token))["leases"][0]["lease"]["uses"] == 2, (
        "its own it may take back"
    )
    vlm = driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    assert refusal(det.unloading(lease)).code == "bad_state", "not at a safe point: others use it"
    driver.post(ClientLeft(second, "gone"))
    runner.use_end(lease, "goal", token)
    det.unload(lease)
    driver.until(lambda: driver.state(vlm) == "loading")


def test_an_acquire_repeated_after_a_restart_reattaches_the_lease_that_it_finds() -> None:
    """The grant was journaled and lost with the daemon, so its holder has nothing to reattach: it
    repeats its acquire. Its renewals count from then on, as those of any holder; otherwise the
    lease ends at the restart's deadline, while the holder is told that it lives and may use it
    until it fences itself (an exclusive lease came beside it: simulation, seed 329)."""
    driver = CoreDriver(8 * GIB)
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, nonce="n", ttl_s=10.0)
    driver.restart()
    waiter = driver.consumer("vlm").acquire(1 * GIB)
    det.connect()
    again = answer(det.try_acquire(5 * GIB, nonce="n", ttl_s=10.0))
    assert (again["state"], again["lease"]["lease_id"]) == ("loading", lease)
    det.load(lease)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=0.1)
    for _ in range(10):
        driver.advance(3.0)
        det.renew((lease, det.token(lease)))
    assert driver.state(lease) == "held"


def test_a_renewal_without_a_reattachment_is_refused(driver: CoreDriver) -> None:
    """Regression: it was answered as alive, while the lease's time to live ran on to its end."""
    det, lease, token = held_with_token(driver, "det", 5, ttl_s=10.0)
    driver.restart()
    det.connect()
    renewed = answer(det.renew((lease, token)))
    assert renewed["alive"] == []
    (gone,) = renewed["gone"]
    assert (gone["error"]["code"], gone["error"]["details"]["misfit"]) == (
        "bad_state",
        "not_reattached",
    )
    det.reattach(lease, token)
    assert answer(det.renew((lease, token)))["alive"] == [lease]


def test_an_empty_gpu_takes_no_lease_from_a_living_holder(driver: CoreDriver) -> None:
    """A reading that says that the GPU is empty may lie, and a model may sleep in host RAM. Nobody
    has to be waited for there, that is all."""
    det, lease, token = held_with_token(driver, "det", 5, ttl_s=10.0)
    loader = driver.consumer("loader")
    loading = loader.acquire(1 * GIB)
    driver.until(lambda: driver.state(loading) == "loading")
    driver.device.held.clear()
    driver.restart()
    assert driver.status()["phase"] == "serving"
    assert (driver.state(lease), driver.state(loading)) == ("held", "loading")
    loader.die()
    small = driver.consumer("small").acquire(2 * GIB)
    driver.until(lambda: driver.state(small) == "loading")
    driver.consumer("w").acquire(1 * GIB, exclusive=True)
    driver.advance(3.0)
    assert not driver.pushes("revoke", lease), "who uses it may be on the way back"
    (waiting,) = driver.why("w")["leases"]
    (blocker,) = (one for one in waiting["blockers"] if one["lease_id"] == lease)
    assert blocker["condition"] == "not_back"
    assert 10.0 <= blocker["seconds"] < 20.0
    assert driver.gpu()["charged_bytes"] == 7 * GIB
    det.connect()
    assert answer(det.reattach(lease, token, uses=["goal"]))["leases"][0]["kept"] is True
    assert driver.state(lease) == "held"


def test_a_revoke_goes_to_the_connection_that_reattached(driver: CoreDriver) -> None:
    """Another of its process, which is as good where that one is gone, knows nothing of it."""
    det, lease, token = held_with_token(driver, "det", 5)
    driver.restart()
    driver.post(ClientConnected(ClientId("a-sibling"), det.process, 1000, "a", "a-sibling"))
    det.connect()
    det.reattach(lease, token)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    pushed = [e for e in driver.effects if isinstance(e, Push)]
    assert [(e.client, e.body.TAG[1]) for e in pushed] == [(det.client, "revoke")]


def test_a_use_keeps_its_label_when_its_holder_comes_back(driver: CoreDriver) -> None:
    """By another connection of the same instance: nobody said that the one before is gone."""
    det, lease, token = held_with_token(driver, "det", 5)
    det.use_begin(lease, label="grab")
    began_at = driver.now
    driver.advance(1.0)
    before, det.client = det.client, ClientId("back")
    instance = f"det-{before}"
    driver.post(ClientConnected(det.client, det.process, det.uid, "det", instance))
    det.reattach(lease, token, uses=("u1", "u2"))
    assert list(driver.arbiter.inspect().leases[lease].uses.values()) == [
        Use(UseId("u1"), det.client, det.process, "grab", began_at),
        Use(UseId("u2"), det.client, det.process, "", driver.now),
    ]


def test_what_a_process_keeps_beyond_its_context_comes_back_after_a_restart_too() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, _ = held_with_token(driver, "det", 5, residue_bytes=450 * MIB)
    det.unloading(lease)
    det.release(lease)
    driver.until(lambda: driver.state(lease) == "over")
    driver.restart()
    det.connect()
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    det.hold(450 * MIB)
    driver.consumer("w").acquire(5 * GIB)
    driver.until(lambda: driver.gpu()["charged_bytes"] == 5 * GIB + 450 * MIB, limit_s=3.0)


def test_a_debt_keeps_its_fence_grace_over_a_restart(driver: CoreDriver) -> None:
    """Regression: the hung holder may still be loading until it fences itself; a restart forgot
    that and gave its room away."""
    hung = driver.consumer("hung")
    lease = hung.acquire(5 * GIB, ttl_s=2.0)
    driver.until(lambda: driver.state(lease) == "over", limit_s=5.0)
    driver.restart()
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(driver.settings.fence_grace_s - 0.5)
    assert driver.state(waiter) == "queued"
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=3.0)


@pytest.mark.parametrize(
    ("how", "kept"),
    [
        (
            {"held": True, "measured_bytes": 4 * GIB},
            {"state": "held", "gpu": "GPU-0", "charge_bytes": 4 * GIB, "measured_bytes": 4 * GIB},
        ),
        ({"held": True}, {"state": "held", "gpu": "GPU-0", "charge_bytes": 3 * GIB}),
        ({"held": False}, {"state": "loading", "gpu": "GPU-0", "charge_bytes": 5 * GIB}),
        ({"away": True}, {"state": "standby", "comes_back": True}),
        (
            {"parked": True},
            {"state": "parked", "comes_back": True, "parks": True, "parked_bytes": GIB},
        ),
    ],
    ids=lambda value: next(iter(value)),
)
def test_the_journal_takes_an_adopted_lease_as_its_holder_tells(
    driver: CoreDriver, how: dict[str, Any], kept: dict[str, Any]
) -> None:
    driver.device.overhead_bytes = 100 * MIB  # unexplained, so that the engine recovers
    det = driver.consumer("det")
    det.hold(3 * GIB)
    driver.restart(keep_journal=False)
    det.connect()
    spec = det.spec(5 * GIB, 3 * GIB, standby=True, park_bytes=GIB)
    answer(det.reattach(LeaseId("L1-50"), Token(1, 50), spec=spec, **how))
    record = driver.journal["lease:L1-50"]
    unlike = {"spec", "nonce", "pid", "start_ticks", "held_from"}
    usual = {
        "lease_id": "L1-50",
        "token": [1, 50],
        "gpu": None,
        "charge_bytes": 0,
        "load_peak_bytes": 5 * GIB,
        "measured_bytes": None,
        "exiting": False,
    }
    assert {key: value for key, value in record.items() if key not in unlike} == usual | kept


def test_adopting_more_than_the_gpu_has_is_pressure_not_a_crash(driver: CoreDriver) -> None:
    det, lease, token = held_with_token(driver, "det", 5)
    driver.restart(keep_journal=False)
    liar = driver.consumer("liar")
    det.connect()
    det.reattach(lease, token)
    liar.reattach(LeaseId("L1-50"), Token(1, 50), spec=liar.spec(6 * GIB))
    assert driver.gpu()["pressure_bytes"] > 0
    driver.advance(16.0)
    assert "revoking" in {driver.state(lease), driver.state(LeaseId("L1-50"))}


def test_one_empty_gpu_of_two_is_not_enough() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    driver.devices[GpuId("GPU-1")].set(driver.consumer("x").process, 1 * GIB, driver.now)
    driver.restart(keep_journal=False)
    assert driver.status()["phase"] == "recovering"


def test_a_reading_from_before_the_restart_voids_nothing(driver: CoreDriver) -> None:
    _, lease, _ = held_with_token(driver, "det", 5)
    records = dict(driver.journal)
    driver = CoreDriver(8 * GIB, start=False)
    driver.post(Recovered(records_of(records)))
    driver.post(MemorySampled(GpuId("GPU-0"), driver.now - 1.0, 0, 8 * GIB, ()))
    assert driver.state(lease) == "held"
    driver.post(MemorySampled(GpuId("GPU-9"), driver.now, 0, 8 * GIB, ()))


def test_the_first_verdict_after_a_restart_needs_no_reading_from_before(driver: CoreDriver) -> None:
    det, lease, _ = held_with_token(driver, "det", 5)
    other = driver.consumer("other")
    driver.device.set(other.process, 1 * GIB, driver.now)
    driver.advance(1.5)
    det.hold(4 * GIB)
    det.release(lease)
    records = dict(driver.journal)
    again = CoreDriver(8 * GIB, start=False)
    again.device.names[other.process] = "other"
    again.device.set(other.process, 6 * GIB, again.now)
    again.post(Recovered(records_of(records)))
    again.advance(11.0)
    (note,) = again.notes("verified")
    assert (note["verdict"], note["before_bytes"]) == ("verified", None), (
        "the stowaway explains the GPU"
    )


def test_records_that_a_full_disk_kept_may_say_more_than_the_gpu_has(driver: CoreDriver) -> None:
    """They used to break the invariant on bytes at the start, and the whole journal was put aside
    for it."""
    _, lease, _ = held_with_token(driver, "det", 5)
    records = dict(driver.journal)
    other = driver.consumer("other")
    stale = {"gpu": "GPU-0", "pid": other.process.pid, "start_ticks": other.process.start_ticks}
    records[f"residue:{other.process}:GPU-0"] = {**stale, "residue_bytes": 4 * GIB}
    records["lease:L1-9"] = {
        **records[f"lease:{lease}"],
        "lease_id": "L1-9",
        "token": [1, 10],
        "nonce": "n9",
    }
    again = CoreDriver(8 * GIB, start=False)
    again.journal = dict(records)
    again.post(Recovered(records_of(records)))
    assert not [key for key in again.journal if key.startswith("residue:")], (
        "nobody would ever take it out"
    )
    assert {lease, "L1-9"} <= {view["lease_id"] for view in again.status()["leases"]}
    assert again.gpu()["pressure_bytes"] > 0, "what was never approved is pressure"
