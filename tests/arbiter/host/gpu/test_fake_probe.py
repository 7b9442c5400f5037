"""The reader of simulated cards, on real files, and the making of a card."""

import json
import os
import threading

import pytest

from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_card, open_cards
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.errors import ConfigError, NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.runtime.fakegpu_folder import locked

GIB = 2**30
PATIENCE_S = 60.0


def edit(card_folder, **changes):
    path = card_folder / "gpu.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def stowaway(card_folder, pid, size, name="browser"):
    (card_folder / f"{name}.json").write_text(
        json.dumps({"pid": pid, "name": name, "allocated_bytes": size})
    )


@pytest.fixture
def card_folder(tmp_path):
    make_card(tmp_path / "card", 8 * GIB, release_lag_s=0.0)
    return tmp_path / "card"


@pytest.fixture
def probe(card_folder):
    probe = FakeProbe([card_folder])
    yield probe
    probe.close()


def test_a_new_card_is_empty(probe):
    (card,) = probe.cards()
    assert (card.index, card.total_bytes) == (0, 8 * GIB)
    reading = probe.sample(card.id)
    assert (reading.used_bytes, reading.total_bytes, reading.processes) == (0, 8 * GIB, ())


def test_a_process_is_listed_with_its_bytes_and_a_dead_one_is_not(probe, card_folder):
    edit(card_folder, release_lag_s=3600)
    stowaway(card_folder, os.getpid(), 2 * GIB)
    stowaway(card_folder, 2**22 + 1, GIB, name="ghost")
    reading = probe.sample(probe.cards()[0].id)
    assert reading.used_bytes == 3 * GIB, "the bytes of the dead are still on the card"
    (use,) = reading.processes
    assert (use.process.pid, use.name, use.used_bytes) == (os.getpid(), "browser", 2 * GIB)


def test_a_name_that_is_cut_in_the_middle_of_a_letter_fails_no_reading(
    probe, card_folder, half_a_letter
):
    """Regression: the kernel cuts names at 15 bytes, and `/proc/PID/stat` was decoded as text."""
    stowaway(card_folder, half_a_letter, GIB)
    (use,) = probe.sample(probe.cards()[0].id).processes
    assert (use.process.pid, use.used_bytes) == (half_a_letter, GIB)


def test_memory_of_the_dead_is_gone_after_the_lag(probe, card_folder):
    stowaway(card_folder, 2**22 + 1, GIB, name="ghost")
    assert probe.sample(probe.cards()[0].id).used_bytes == 0
    assert not [path for path in card_folder.iterdir() if fakegpu.is_process_file(path.name)]


def test_a_probe_can_fail_and_recover(probe, card_folder):
    gpu = probe.cards()[0].id
    edit(card_folder, faults={"probe": "fail"})
    with pytest.raises(ProbeFailed, match=r"gpu\.json says so"):
        probe.sample(gpu)
    edit(card_folder, faults={})
    assert probe.sample(gpu).used_bytes == 0


def test_a_hang_ends_with_the_fault_or_with_close(probe, card_folder):
    gpu = probe.cards()[0].id
    edit(card_folder, faults={"probe": "hang"})
    outcome: list[object] = []

    def read():
        try:
            outcome.append(probe.sample(gpu))
        except ProbeFailed as error:
            outcome.append(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(0.2)
    assert thread.is_alive()
    probe.close()
    thread.join(PATIENCE_S)
    assert isinstance(outcome[0], ProbeFailed)


def test_processes_can_be_hidden(probe, card_folder):
    edit(card_folder, faults={"hide_processes": True})
    stowaway(card_folder, os.getpid(), GIB)
    reading = probe.sample(probe.cards()[0].id)
    assert (reading.used_bytes, reading.processes) == (GIB, None)


def test_a_broken_file_is_a_failed_reading_not_a_free_card(probe, card_folder):
    gpu = probe.cards()[0].id
    (card_folder / "7-7.json").write_text("{")
    with pytest.raises(ProbeFailed, match=r"7-7\.json"):
        probe.sample(gpu)


def test_unknown_cards(probe, tmp_path):
    with pytest.raises(UnknownGpu):
        probe.sample(GpuId("GPU-no"))
    with pytest.raises(NoGpu, match="--gpu fake:8GiB"):
        FakeProbe([tmp_path])


def test_sizes_make_cards_in_the_runtime_folder_and_a_second_start_keeps_them(tmp_path):
    first = open_cards("8GiB,16GiB", tmp_path)
    assert [(card.index, card.total_bytes) for card in first.cards()] == [
        (0, 8 * GIB),
        (1, 16 * GIB),
    ]
    stowaway(tmp_path / "fakegpu", os.getpid(), GIB)
    again = open_cards("8GiB,16GiB", tmp_path)
    assert again.cards() == first.cards()
    assert again.sample(again.cards()[0].id).used_bytes == GIB
    with pytest.raises(ConfigError, match="in use here"):
        open_cards("4GiB", tmp_path)
    (tmp_path / "fakegpu" / "browser.json").unlink()
    assert open_cards("4GiB", tmp_path).cards()[0].total_bytes == 4 * GIB
    assert open_cards(str(tmp_path / "fakegpu"), tmp_path).cards()[0].total_bytes == 4 * GIB
    with pytest.raises(ConfigError, match="write fake:8GiB"):
        open_cards("much", tmp_path)


def test_a_reboot_voids_what_processes_held(tmp_path):
    make_card(tmp_path, 8 * GIB)
    edit(tmp_path, boot_id="an earlier one")
    stowaway(tmp_path, os.getpid(), GIB)
    make_card(tmp_path, 8 * GIB)
    probe = FakeProbe([tmp_path])
    assert probe.sample(probe.cards()[0].id).used_bytes == 0


def test_readings_wait_for_the_lock(probe, card_folder):
    gpu = probe.cards()[0].id
    done = threading.Event()

    def read():
        probe.sample(gpu)
        done.set()

    with locked(card_folder):
        thread = threading.Thread(target=read)
        thread.start()
        assert not done.wait(0.1)
    assert done.wait(PATIENCE_S)
    thread.join()


def test_what_a_killed_process_left_half_written_is_mended(probe, card_folder):
    line = {"seq": 1, "t": 0.0, "pid": os.getpid(), "start": 0, "name": "", "op": "alloc",
    "label": "", "bytes": 5, "delta": 5,
            "process_bytes": 5, "used_after": 5, "capacity": 8 * GIB}  # fmt: skip
    (card_folder / "half.json").write_text(
        json.dumps({"pid": os.getpid(), "allocated_bytes": 5, "last": line})
    )
    (card_folder / fakegpu.LOG_FILE).write_text('{"seq": 1, "t"')
    probe.sample(probe.cards()[0].id)
    assert json.loads((card_folder / fakegpu.LOG_FILE).read_text().splitlines()[1]) == line
