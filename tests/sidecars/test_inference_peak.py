"""A resident model is charged its inference peak, also once it reported its own bytes."""

import pytest

pytestmark = pytest.mark.e2e


def test_the_lease_of_a_resident_model_covers_its_inference_peak(box, arbiter):
    """Regression: the bytes that a sidecar measures when it is resident, before its first answer,
    replaced the charge, and the activations of the next answer had no room."""
    sidecar = box.start("detector", footprint="1GB,1GB,100MB,2GB")
    assert sidecar.detect()["ok"]
    (lease,) = arbiter.ask("status")["leases"]
    assert (lease["state"], lease["charge_bytes"]) == ("held", 2 * 10**9)
    assert 10**9 <= box.used() < 2 * 10**9
