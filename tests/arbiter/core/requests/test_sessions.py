"""Connections that come and go, deaths, and a journal that fails."""

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import give_back, held
from vram_arbiter.arbiter.core.effects import Note, Push, Refuse
from vram_arbiter.arbiter.core.events import ClientConnected, ClientLeft
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import ClientId, GpuId


def test_a_use_that_was_repeated_on_a_new_connection_outlives_the_old_one() -> None:
    driver = CoreDriver(8 * GIB)
    det, runner = driver.consumer("det"), driver.consumer("runner")
    held = det.acquire(2 * GIB)
    det.load(held)
    runner.use_begin(held, "goal", det.token(held))
    old, runner.client = runner.client, ClientId("new")
    runner.connect()
    runner.use_begin(held, "goal", det.token(held))
    driver.post(ClientLeft(old, "silent"))
    assert not driver.notes("use_ended")
    runner.leave("bye")
    assert driver.notes("use_ended")


def test_pushes_go_to_another_living_connection_of_the_process(driver: CoreDriver) -> None:
    first = driver.consumer("det", pid=500)
    held = first.acquire(5 * GIB)
    first.load(held)
    second = driver.consumer("det", pid=500)
    second.client = ClientId("c500-2")
    second.connect()
    first.leave("misconduct")
    effects = driver.consumer("vlm").try_acquire(5 * GIB)
    assert [e.client for e in effects if isinstance(e, Push)] == ["c500-2"]
    second.leave("misconduct")
    driver.advance(0.3)
    assert [e for e in driver.effects if isinstance(e, Push)][-1].client == "c500", (
        "nobody is there: the last known"
    )


def test_a_death_during_verification_needs_no_residue_any_more(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, residue_bytes=1 * GIB)
    det.unload(lease)
    det.die()
    driver.until(lambda: driver.state(lease) == "over")
    assert driver.gpu()["charged_bytes"] == 0
    assert driver.journal == {}


def test_a_grant_taken_back_leaves_the_residue_of_its_process_charged(driver: CoreDriver) -> None:
    """Regression: with the grant the ledger forgot the context that the process had all along."""
    det, lease = held(driver, "det", 5, residue_bytes=1 * GIB)
    give_back(driver, det, lease)
    driver.restart()
    det.connect()
    driver.until(lambda: bool(driver.notes("serving")), limit_s=30.0)
    assert driver.gpu()["charged_bytes"] == 1 * GIB
    driver.journal_failing = "disk full"
    det.try_acquire(2 * GIB)
    driver.advance(0.1)
    assert driver.gpu()["charged_bytes"] == 1 * GIB


def test_a_grant_in_reply_that_cannot_be_written_is_refused_once(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    driver.journal_failing = "disk full"
    det.try_acquire(5 * GIB)
    refused = [effect for effect in driver.effects if isinstance(effect, Refuse)]
    assert [refuse.refusal.code for refuse in refused] == ["journal_unavailable"]
    assert driver.gpu()["charged_bytes"] == 0
    notes = [effect.kind for effect in driver.effects if isinstance(effect, Note)]
    assert notes[-2:] == ["journal_failed", "denied"]


def test_a_loading_holder_is_not_undone_by_a_later_record(driver: CoreDriver) -> None:
    """Regression: a pin that a full disk did not take withdrew the lease of a holder that was
    loading, and its bytes were given away."""
    det, ops = driver.consumer("det"), driver.consumer("ops")
    loading = det.acquire(5 * GIB)
    driver.journal_failing = "disk full"
    ops.order("pin", loading, "demo", "uid 0")
    assert driver.notes("journal_failed")
    assert driver.state(loading) == "loading"
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    assert not driver.pushes("denied")


def test_who_owns_bytes_of_a_gpu_and_who_is_connected() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    first, second = driver.devices
    det, watcher = driver.consumer("det"), driver.consumer("watcher")
    assert driver.arbiter.owners(first) == frozenset(), "nobody holds a lease"
    assert driver.arbiter.clients() == {det.process, watcher.process}
    lease = det.acquire(2 * GIB, gpu=first)
    assert [driver.arbiter.concerns(one.client) for one in (det, watcher)] == [True, False]
    det.load(lease)
    assert (driver.arbiter.owners(first), driver.arbiter.owners(second)) == (
        {det.process},
        frozenset(),
    )
    assert driver.arbiter.owners(GpuId("GPU-none")) == frozenset()
    det.die()
    assert driver.arbiter.clients() == {watcher.process}
    assert driver.arbiter.owners(first) == {det.process}, "a debt is not measured gone yet"
    driver.until(lambda: not driver.arbiter.owners(first))


def test_an_instance_that_reconnects_is_one_client_with_everything_that_was_its_own() -> None:
    """However often it comes back: a client that reconnects for ever used to be remembered for
    ever."""
    driver = CoreDriver(8 * GIB)
    det, other = driver.consumer("det"), driver.consumer("other")
    held = det.acquire(2 * GIB)
    det.load(held)
    lent = other.acquire(1 * GIB)
    driver.until(lambda: driver.state(lent) == "loading")
    other.load(lent)
    det.use_begin(held, "mine")
    det.use_begin(lent, "theirs", other.token(lent))
    other.use_begin(lent, "its own")
    queued = det.acquire(7 * GIB)
    beside = Consumer(driver, "beside", det.process, ClientId("beside"))
    beside.connect()
    theirs = beside.acquire(7 * GIB, nonce="theirs")
    for number in range(3):
        det.client = ClientId(f"new{number}")
        driver.post(ClientConnected(det.client, det.process, 1000, "det", "det-c101"))
    assert driver.status()["clients"] == 3
    det.leave("silent")
    assert (driver.state(queued), driver.state(theirs)) == ("over", "queued")
    views = (driver.view(held), driver.view(lent))
    assert [view and view["uses"] for view in views] == [0, 1], (
        "its uses end with its newest connection"
    )


def test_a_connection_that_says_hello_as_another_instance_is_only_that(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    driver.post(ClientConnected(det.client, det.process, 1000, "det", "second"))
    back = ClientId("back")
    driver.post(ClientConnected(back, det.process, 1000, "det", "det-c101"))
    assert driver.status()["clients"] == 2, "nobody was taken over"


def test_whoever_says_bye_and_lives_on_keeps_its_context(driver: CoreDriver) -> None:
    """The process did not exit: measuring its context away would take for ever."""
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    det.hold(450 * MIB)
    det.leave()
    driver.until(lambda: driver.state(lease) == "over", limit_s=1.0)
    assert driver.gpu()["charged_bytes"] == 450 * MIB


def test_a_client_that_only_uses_anothers_lease_is_a_concern(driver: CoreDriver) -> None:
    """Whoever is none is forgotten as soon as its connection is lost, and its uses end."""
    det, lease = held(driver, "det", 5)
    runner = driver.consumer("runner")
    assert not driver.arbiter.concerns(runner.client)
    runner.use_begin(lease, "goal", det.token(lease))
    assert driver.arbiter.concerns(runner.client)
    runner.use_end(lease, "goal", det.token(lease))
    assert not driver.arbiter.concerns(runner.client)
