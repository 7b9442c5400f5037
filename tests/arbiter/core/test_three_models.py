"""The loop that the product exists for: detector, VLM and policy on one GPU of 8 GiB."""

from tests.support.core_driver import Consumer, CoreDriver, refusal
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

RESIDUE = 450 * d.MIB
DETECTOR, VLM, POLICY = 5_300_000_000, 3_300_000_000, 4_300_000_000


def test_the_budget_says_who_fits_beside_whom() -> None:
    budget = 8 * d.GIB - 300 * d.MIB
    assert budget >= VLM + POLICY + RESIDUE  # both, beside the detector's context
    assert budget < DETECTOR + VLM
    assert budget < DETECTOR + POLICY


class Robot:
    """Three long-lived processes and the runner that marks goals on the policy's lease."""

    def __init__(self) -> None:
        self.driver = CoreDriver(8 * d.GIB)
        self.detector = self.driver.consumer("detector")
        self.vlm = self.driver.consumer("vlm")
        self.policy = self.driver.consumer("policy")
        self.runner = self.driver.consumer("runner")

    def acquire(self, who: Consumer, count: int) -> LeaseId:
        return who.acquire(count, residue_bytes=RESIDUE, min_residency_s=d.MIN_RESIDENCY_S)

    def loaded(self, who: Consumer, count: int) -> LeaseId:
        lease = self.acquire(who, count)
        self.driver.until(lambda: self.driver.state(lease) == "loading")
        who.load(lease)
        return lease

    def asked(self, lease: LeaseId) -> bool:
        return bool(self.driver.pushes("revoke", lease))


def test_find_navigate_grab_and_find_again() -> None:
    robot = Robot()
    driver = robot.driver
    driver.device.lag_s = 0.8  # the driver gives memory back late

    # the VLM is resident and idle; the detector needs the GPU
    vlm = robot.loaded(robot.vlm, VLM)
    ready_at = driver.now
    detector = robot.acquire(robot.detector, DETECTOR)
    assert not robot.asked(vlm), "it may stay for its minimum residency"
    driver.until(lambda: robot.asked(vlm))
    assert driver.now - ready_at >= d.MIN_RESIDENCY_S
    robot.vlm.ack(vlm, 0.0)
    robot.vlm.unload(vlm)
    assert driver.state(detector) == "queued", "released is not free"
    took = driver.until(lambda: driver.state(detector) == "loading")
    assert took >= driver.device.lag_s, "granted only when the bytes were measured gone"
    assert driver.notes("verified")[-1]["verdict"] == "verified"
    robot.detector.load(detector)
    assert driver.notes("switch")[-1]["evicted"][0]["consumer"] == "vlm"
    assert driver.notes("switch")[-1]["verified"] is True

    # the policy is wanted: the detector goes
    policy = robot.acquire(robot.policy, POLICY)
    driver.until(lambda: robot.asked(detector))
    robot.detector.unload(detector)
    driver.until(lambda: driver.state(policy) == "loading")
    robot.policy.load(policy)

    # the VLM fits beside the policy and the detector's residue: nobody has to go
    vlm = robot.loaded(robot.vlm, VLM)
    assert driver.notes("switch")[-1]["switched"] is False
    assert not robot.asked(policy)
    assert driver.gpu()["charged_bytes"] == VLM + POLICY + RESIDUE

    # the runner runs a goal on the policy's lease; the detector needs both to go and waits for the
    # goal
    robot.runner.use_begin(policy, "goal-1", robot.policy.token(policy), "grab")
    driver.advance(d.MIN_RESIDENCY_S)
    detector = robot.acquire(robot.detector, DETECTOR)
    assert robot.asked(vlm)
    assert robot.asked(policy)
    assert driver.pushes("revoke", policy)[-1]["uses"] == 1
    robot.vlm.unload(vlm)
    robot.policy.ack(policy, 3.0)
    refused = refusal(robot.policy.unloading(policy))
    assert refused.code == "bad_state", "not before the safe point"
    driver.advance(3.0)
    assert driver.state(detector) == "queued"
    assert driver.state(policy) == "revoking"
    text = driver.why("detector")["leases"][0]["text"]
    assert (
        'waits for policy to finish 1 use "grab" (revoked 3.0 s ago), then it unloads and 4.00 GiB '
        "are verified" in text
    )

    robot.runner.use_end(policy, "goal-1", robot.policy.token(policy))
    assert driver.pushes("revoke", policy)[-1]["uses"] == 0, (
        "told at once that it is at its safe point"
    )
    robot.policy.unload(policy)
    driver.until(lambda: driver.state(detector) == "loading")
    robot.detector.load(detector)
    switch = driver.notes("switch")[-1]
    assert sorted(e["consumer"] for e in switch["evicted"]) == ["policy", "vlm"]
    assert switch["drain_ms"] >= 3000
    assert switch["verify_ms"] >= 800
    assert driver.gpu()["charged_bytes"] == DETECTOR + 2 * RESIDUE
