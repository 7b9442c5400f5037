"""A reading that cannot be true says nothing: its GPU is unknown. A driver that called a GPU of 8
GiB one of 2^60 bytes, or -1 bytes used, made room for grants that did not exist."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held
from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ProcessKey

LIES: list[dict[str, Any]] = [
    {"used_bytes": -1},
    {"used_bytes": 9 * GIB},
    {"used_bytes": 1 << 60},
    {"total_bytes": 1 << 60},
    {"total_bytes": 0},
    {"total_bytes": -8 * GIB},
    {"total_bytes": 4 * GIB},
    {"total_bytes": 16 * GIB},
    {"processes": (ProcessUse(ProcessKey(9, 9), "odd", 1 << 60),)},
    {
        "processes": (
            ProcessUse(ProcessKey(9, 9), "odd", None),
            ProcessUse(ProcessKey(8, 8), "odd", -5),
        )
    },
]


@pytest.mark.parametrize("lie", LIES)
def test_nothing_is_granted_on_an_impossible_reading_until_a_plausible_one(
    driver: CoreDriver, lie: dict[str, Any]
) -> None:
    """Regression: a changed capacity, -1 or 2^60 bytes used were believed."""
    driver.device.lies = lie
    driver.advance(3.0)
    waiter = driver.consumer("waiter").acquire(GIB)
    driver.advance(3.0)
    assert driver.state(waiter) == "queued"
    gpu = driver.gpu()
    assert gpu["measured_used_bytes"] is None
    assert "impossible reading" in gpu["blocked"]["text"]
    assert [note["reason"] in gpu["blocked"]["text"] for note in driver.notes("probe_failed")] == [
        True
    ], "once"
    driver.device.lies = {}
    driver.until(lambda: driver.state(waiter) == "loading")
    assert len(driver.notes("probe_ok")) == 1


def test_a_first_reading_that_cannot_be_true_is_no_measure_for_later_ones() -> None:
    driver = CoreDriver(8 * GIB, start=False)
    driver.device.lies = {"total_bytes": 1 << 60}
    driver.advance(0.1)
    assert "impossible reading" in driver.gpu()["blocked"]["text"]
    driver.device.lies = {}
    driver.advance(3.0)
    assert driver.gpu()["blocked"] is None


def test_bytes_are_not_measured_gone_by_an_impossible_reading(driver: CoreDriver) -> None:
    det, _ = held(driver, "det", 5)
    driver.device.lies = {"used_bytes": -(1 << 40), "processes": ()}
    det.die()
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    driver.device.lies = {}
    driver.advance(3.0)
    assert driver.gpu()["charged_bytes"] == 0


def test_an_empty_gpu_that_cannot_be_true_accounts_for_no_holder_after_a_restart() -> None:
    driver = CoreDriver(8 * GIB)
    held(driver, "det", 5)
    driver.device.lies = {"used_bytes": -1}
    driver.restart()
    driver.advance(2.0)
    assert driver.status()["phase"] == "recovering"


def test_a_reading_is_compared_with_what_is_leased_out_where_the_whole_is_not_known() -> None:
    """Logs may name a capacity only; a larger whole is plausible there."""
    driver = CoreDriver(8 * GIB)
    (info,) = driver.settings.gpus
    driver.settings = replace(driver.settings, gpus=(replace(info, total_bytes=0),))
    driver.device.lies = {"total_bytes": 4 * GIB}
    driver.restart(keep_journal=False)
    driver.advance(1.0)
    assert f"{8 * GIB} are leased out" in driver.notes("probe_failed")[-1]["reason"]
    driver.device.lies = {"total_bytes": 16 * GIB}
    driver.advance(2.0)
    assert driver.gpu()["measured_used_bytes"] == 0
