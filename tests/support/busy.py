"""A run of the engine with a bit of everything, reproducible from a seed. For tests of logs and
replays."""

from random import Random

from tests.support.core_driver import Consumer, CoreDriver
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId

PROBE_FAILURE = "the driver hangs"
"""What a failed reading of the driver reports."""


def busy_driver(seed: int, steps: int = 120) -> CoreDriver:
    """Four consumers that load, use, release, cancel, report and die, on a GPU that lags and
    sometimes cannot be read."""
    random = Random(seed)
    driver = CoreDriver()
    driver.device.lag_s = 0.03
    driver.device.overhead_bytes = 200 * MIB
    people = {name: driver.consumer(name) for name in ("detector", "vlm", "grab", "chat")}
    held: dict[LeaseId, Consumer] = {}
    for _ in range(steps):
        driver.advance(random.choice((0.01, 0.1, 0.7, 3.0)))
        held = {lease: person for lease, person in held.items() if driver.state(lease) != "over"}
        name, person = random.choice(sorted(people.items()))
        mine = [lease for lease, owner in held.items() if owner is person]
        match random.randrange(12):
            case 0 | 1 | 2:
                person.try_acquire(
                    int(random.choice((1.0, 3.3, 4.3, 5.3, 9.0)) * GIB),
                    residue_bytes=random.choice((0, 300 * MIB)),
                    priority=random.choice((20, 50, 80)),
                    min_residency_s=random.choice((0.0, 2.0)),
                    wait_timeout_s=random.choice((None, 5.0)),
                )
                for view in driver.status()["leases"]:
                    lease = LeaseId(view["lease_id"])
                    if view["consumer"] == name and lease not in held:
                        held[lease] = person
                        person.specs[lease] = driver.arbiter.inspect().leases[lease].spec
            case 3:
                driver.device.failing = "" if driver.device.failing else PROBE_FAILURE
            case 4 if random.random() < 0.3:
                person.die()
                people[name] = driver.consumer(name)
            case _:
                for lease in mine:
                    _live(driver, person, lease, random)
    return driver


def _live(driver: CoreDriver, person: Consumer, lease: LeaseId, random: Random) -> None:
    match driver.state(lease):
        case "loading":
            person.load(lease)
        case "held":
            random.choice((person.use_begin, person.use_end, lambda x: person.oom(x, 8 * GIB)))(
                lease
            )
        case "revoking":
            person.ack(lease)
            person.use_end(lease)
            person.unload(lease)
        case "queued" if random.random() < 0.1:
            person.cancel(lease)
        case _:
            pass
