"""What the GPUs hold by consumer, from the status of a real engine."""

from collections.abc import Mapping

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held
from vram_arbiter.clients.observer import figures
from vram_arbiter.clients.observer.figures import RESIDUES, STOWAWAYS, UNATTRIBUTED
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import ProcessKey


def shown(driver: CoreDriver) -> tuple[Mapping[str, int], Mapping[str, int], int | None]:
    """Charged and measured bytes by consumer, and the bytes in use."""
    status = driver.arbiter.status(driver.now)
    (gpu,) = status.gpus
    charged, measured = figures.charged(gpu, status), figures.measured(gpu, status)
    return charged, measured, gpu.measured_used_bytes


def test_what_is_charged_and_measured_by_consumer() -> None:
    driver = CoreDriver(8 * GIB)
    person, _ = held(driver, "det", 2)
    held(driver, "det", 1)
    held(driver, "vlm", 3)
    driver.consumer("policy").acquire(4 * GIB)
    driver.device.set(ProcessKey(99, 1), 64 * MIB, driver.now)
    driver.device.set(person.process, 2 * GIB + MIB, driver.now)
    driver.advance(1.1)
    assert shown(driver) == (
        {"det": 3 * GIB, "vlm": 3 * GIB},
        {"det": 3 * GIB + MIB, "vlm": 3 * GIB, STOWAWAYS: 64 * MIB},
        6 * GIB + 65 * MIB,
    )
    assert figures.oldest_wait_s(driver.arbiter.status(driver.now)) >= 1.0


def test_residues_have_no_consumer_and_shared_processes_both() -> None:
    driver = CoreDriver(8 * GIB)
    person, lease = held(driver, "det", 2, residue_bytes=512 * MIB)
    both, _ = held(driver, "vlm", 1)
    both.name = "helper"
    held(driver, "helper", 1, person=both)
    driver.device.set(both.process, 2 * GIB, driver.now)
    person.unload(lease)
    driver.device.set(person.process, 512 * MIB, driver.now)
    driver.until(lambda: driver.state(lease) == "over")
    driver.advance(1.1)
    assert shown(driver) == (
        {"vlm": GIB, "helper": GIB, RESIDUES: 512 * MIB},
        {"helper+vlm": 2 * GIB, RESIDUES: 512 * MIB},
        2 * GIB + 512 * MIB,
    )


def test_a_gpu_that_cannot_be_read_shows_no_bytes() -> None:
    driver = CoreDriver(8 * GIB, start=False)
    assert shown(driver)[1:] == ({}, None), "not read yet"
    driver.advance(0.01)
    driver.device.lists_processes = False
    held(driver, "det", 2)
    assert shown(driver)[1] == {UNATTRIBUTED: 2 * GIB}
    driver.device.lists_processes, driver.device.knows_bytes = True, False
    driver.advance(1.1)
    assert shown(driver)[1] == {UNATTRIBUTED: 2 * GIB}, "listed, without their bytes"
    driver.device.failing = "lost"
    driver.advance(1.1)
    assert shown(driver) == ({"det": 2 * GIB}, {}, None)
