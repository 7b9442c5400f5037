"""Tokens are secrets. A token is all that another process needs to mark uses on a lease and keep it
from being evicted, so a stranger that could read it in `status`, or guess it, could keep a holder
on its GPU for ever.
"""

from itertools import pairwise
from typing import Any

from tests.support.core_driver import CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Note, Push, Refuse, Reply
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import Token

SECRET = "5e" * 16


def test_a_token_is_shown_to_its_holder_and_to_an_operator_only(driver: CoreDriver) -> None:
    det, lease = driver.consumer("det"), None
    lease = det.acquire(5 * GIB)
    token = det.token(lease)
    stranger = driver.consumer("stranger")

    def shown(*reader: Any) -> dict[str, Any]:
        (view,) = driver.status(*reader)["leases"]
        return dict(view)

    assert Token(*shown()["token"]) == Token(*shown(det.process)["token"]) == token
    assert shown(stranger.process)["token"] is None
    refused = refusal(stranger.use_begin(lease, token=Token(1, 99)))
    assert (refused.code, refused.details) == (
        "stale_token",
        {"lease_id": lease, "token": "1.99"},
    ), "the right token is not given away"


def test_nothing_that_is_said_to_others_holds_a_token() -> None:
    """Every effect of a lease's life, from the acquire to the verdict, with a stranger that asks
    for everything it may."""
    driver = CoreDriver(8 * GIB, settings={"token_secret": SECRET})
    det, other = driver.consumer("det"), driver.consumer("other")
    lease = det.acquire(5 * GIB, standby=True)
    token = det.token(lease)
    det.load(lease)
    det.use_begin(lease)
    for wrong in (Token(1, 1), Token(2, token.serial + 1)):
        other.use_begin(lease, token=wrong)
        other.release(lease, token=wrong)
        other.renew((lease, wrong))
        other.reattach(lease, wrong, spec=other.spec(5 * GIB))
    other.release(lease, token=token)
    other.acquire(5 * GIB, wait_timeout_s=1.0)
    driver.advance(2.0)
    det.use_end(lease)
    det.unload(lease)
    driver.advance(2.0)
    told = [
        effect
        for effect in driver.effects
        if isinstance(effect, (Reply, Push, Refuse)) and effect.client != det.client
    ]
    notes = [effect for effect in driver.effects if isinstance(effect, Note)]
    assert len(told) > 10
    assert {"granted", "use_began", "revoke_asked", "released"} <= {note.kind for note in notes}
    own = {str(view["token"][1]) for view in (driver.view(lease),) if view} | {str(token.serial)}
    for effect in [*told, *notes, driver.status(other.process), driver.why("det")]:
        assert not any(serial in repr(effect) for serial in own), effect


def test_a_token_cannot_be_guessed_from_the_lease_id_or_from_another_token() -> None:
    """Regression: tokens were the next number, so any client could keep a holder in use
    for ever."""

    def tokens(secret: str) -> list[int]:
        driver = CoreDriver(8 * GIB, settings={"token_secret": secret})
        job = driver.consumer("job")
        found = []
        for _ in range(8):
            lease = job.acquire(GIB)
            found.append(job.token(lease).serial)
            job.load(lease)
            assert answer(job.release(lease))["state"] == "verifying"
            driver.advance(1.0)
        return found

    grown = tokens(SECRET)
    assert grown == sorted(grown), "tokens only grow"
    gaps = [second - first for first, second in pairwise(grown)]
    assert min(gaps) > 1000
    assert len(set(gaps)) == len(gaps)
    assert grown == tokens(SECRET), (
        "the same settings give the same tokens: a replay finds them again"
    )
    assert not set(grown) & set(tokens("17" * 16))
    assert max(grown) + 2**32 < 2**63
