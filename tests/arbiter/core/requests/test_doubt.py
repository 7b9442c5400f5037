"""A restart with a journal in doubt: it may have lost records, so holders know more than
it does."""

from tests.support.core_driver import CoreDriver, answer
from tests.support.scenes import held, sent_away
from vram_arbiter.arbiter.core.events import DOUBT_KEY
from vram_arbiter.schemas.defaults import GIB


def doubting() -> CoreDriver:
    driver = CoreDriver(16 * GIB)
    driver.journal[DOUBT_KEY] = {"why": "its seal is missing"}
    return driver


def test_a_holder_with_a_later_token_is_believed() -> None:
    """Its lease was granted again, and the record of that grant is lost. Without a doubt the token
    is refused."""
    for doubt in (True, False):
        driver = doubting()
        if not doubt:
            del driver.journal[DOUBT_KEY]
        det, lease = held(driver, "det", 5)
        before = det.token(lease)
        later = type(before)(before.epoch, before.serial + 40)
        driver.restart()
        det.connect()
        (kept,) = answer(det.reattach(lease, later, uses=["grab"]))["leases"]
        assert kept["kept"] is doubt
        if doubt:
            assert (kept["lease"]["state"], kept["lease"]["uses"]) == ("held", 1)
            assert driver.journal[f"lease:{lease}"]["token"] == [later.epoch, later.serial]
            det.use_end(lease, "grab", later)
        else:
            assert kept["error"]["code"] == "stale_token"


def test_a_holder_with_a_token_of_this_start_is_not_believed() -> None:
    driver = doubting()
    det, lease = held(driver, "det", 5)
    token = det.token(lease)
    driver.restart(epoch=2)
    det.connect()
    (kept,) = answer(det.reattach(lease, type(token)(2, 1)))["leases"]
    assert kept["error"]["code"] == "stale_token"
    other = driver.consumer("other")
    (kept,) = answer(other.reattach(lease, type(token)(1, 99), spec=det.specs[lease]))["leases"]
    assert kept["error"]["code"] in ("stale_token", "not_permitted"), "nor another process"


def test_a_lease_that_was_away_is_what_its_holder_says(driver: CoreDriver) -> None:
    """Its record says that it holds nothing; the record of its return may be lost."""
    det, lease, policy, wanted = sent_away(driver)
    old, spec = det.token(lease), det.specs[lease]
    policy_token = policy.token(wanted)
    driver.journal[DOUBT_KEY] = {"why": "its log was cut"}
    driver.restart()
    assert driver.state(lease) == "over", "it is not remembered as away"
    det.connect()
    policy.connect()
    answer(policy.reattach(wanted, policy_token))
    (kept,) = answer(det.reattach(lease, old, spec=spec, away=True))["leases"]
    assert (kept["kept"], kept["lease"]["state"]) == (True, "standby"), (
        "adopted as its holder tells"
    )
