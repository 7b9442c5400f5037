"""Bytes and faults of a simulated GPU by hand, without a daemon."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE, SimulatedOutOfMemory
from vram_arbiter.testing.gpu import FakeGpu
from vram_arbiter.testing.waiting import parse_lag


@pytest.fixture
def gpu(tmp_path: Path) -> FakeGpu:
    make_gpu(tmp_path, 8 * GIB, release_lag_s=0.0)
    return FakeGpu(tmp_path)


def listed(gpu: FakeGpu) -> dict[int, int] | None:
    """Return the bytes of each process that a reading lists."""
    probe = FakeProbe([gpu.folder])
    (device,) = probe.gpus()
    processes = probe.sample(device.id).processes
    return (
        None if processes is None else {one.process.pid: one.used_bytes or 0 for one in processes}
    )


def test_bytes_come_and_go(gpu: FakeGpu) -> None:
    gpu.allocate("5GiB")
    assert (gpu.used_bytes, gpu.free_bytes) == (5 * GIB, 3 * GIB)
    with pytest.raises(SimulatedOutOfMemory):
        gpu.allocate("4GiB")
    gpu.free()
    assert gpu.used_bytes == 0


def test_a_stowaway_is_a_process_of_its_own(gpu: FakeGpu) -> None:
    with gpu.stowaway("2GiB") as pid:
        assert pid != os.getpid()
        assert listed(gpu) == {pid: 2 * GIB}
    assert gpu.used_bytes == 0


def test_nothing_fits_where_memory_is_out(gpu: FakeGpu) -> None:
    with gpu.stowaway(), pytest.raises(SimulatedOutOfMemory):
        gpu.allocate(1)
    gpu.allocate(1)


def test_processes_are_hidden(gpu: FakeGpu) -> None:
    gpu.allocate("1GiB")
    with gpu.edited(hide_processes=True):
        assert listed(gpu) is None
    assert listed(gpu) == {os.getpid(): GIB}


def test_a_reading_fails(gpu: FakeGpu) -> None:
    with gpu.edited(probe="fail"), pytest.raises(ProbeFailed):
        listed(gpu)
    assert listed(gpu) == {}


CHANGES: dict[str, object] = {"probe": "hang", "hide_processes": True, "release_lag_s": 2.0}


@pytest.mark.parametrize("outer", CHANGES)
@pytest.mark.parametrize("inner", CHANGES)
def test_a_block_turns_off_what_it_turned_on(gpu: FakeGpu, outer: str, inner: str) -> None:
    def config() -> Any:
        return json.loads((gpu.folder / "gpu.json").read_text())

    before = config()
    with gpu.edited(**{outer: CHANGES[outer]}):
        within = config()
        assert within != before
        with gpu.edited(**{inner: CHANGES[inner]}):
            assert config() != before
        assert config() == within
    assert config() == before


def test_wrong_input_says_what_is_right(gpu: FakeGpu, monkeypatch: pytest.MonkeyPatch) -> None:
    for call, error, said in (
        (lambda: gpu.allocate("8 bananas"), ValueError, "8GiB"),
        (lambda: parse_lag("soon"), ValueError, "500ms or 1.5s, got 'soon'"),
        (lambda: parse_lag(0.5), ValueError, "500ms or 1.5s, got 0.5"),
        (lambda: gpu.edit(release_lag_s=-1.0), ConfigError, "release_lag_s"),
        (lambda: gpu.edit(prob="fail"), ConfigError, "prob"),
        (FakeGpu, NoGpu, FOLDER_VARIABLE),
    ):
        monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
        with pytest.raises(error) as raised:
            call()
        assert said in f"{raised.value} {getattr(raised.value, 'hint', '')}"


@pytest.mark.parametrize(("text", "lag_s"), [("500ms", 0.5), ("1.5s", 1.5), ("2 s", 2.0)])
def test_a_lag_is_read(text: str, lag_s: float) -> None:
    assert parse_lag(text) == lag_s
