"""Pids of a driver that counts in the host's namespace, for a daemon that lives in one of its own.
Both /proc are folders."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from vram_arbiter.arbiter.host.gpu.pids import INITIAL_NAMESPACE, PidMap
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.procfs import start_ticks


def process(proc: Path, pid: int, ticks: int, name: str, nspid: Sequence[int]) -> None:
    folder = proc / str(pid)
    folder.mkdir(parents=True)
    fields = ["S", "1", *["0"] * 17, str(ticks), "0"]
    (folder / "stat").write_text(f"{pid} ({name}) {' '.join(fields)}\n")
    (folder / "cmdline").write_bytes(f"/usr/bin/{name}\0-m\0serve\0".encode())
    (folder / "status").write_text(
        f"Name:\t{name}\nNSpid:\t{chr(9).join(map(str, nspid))}\nThreads:\t1\n"
    )


def namespace(proc: Path, link: str) -> Path:
    (proc / "self" / "ns").mkdir(parents=True)
    os.symlink(link, proc / "self" / "ns" / "pid")
    return proc


@pytest.fixture
def container(tmp_path: Path) -> tuple[Path, Path]:
    """(own /proc, the host's): host pid 500 is 7 here; host pid 7 is somebody else; 600 is in
    another container, as 7 too."""
    own, host = namespace(tmp_path / "own", "pid:[4026532999]"), tmp_path / "host"
    process(own, 7, 1111, "detector", [7])
    process(host, 500, 1111, "detector", [500, 7])
    process(host, 7, 2222, "Xorg", [7])
    process(host, 600, 3333, "other", [600, 7])
    return own, host


def test_on_a_host_pids_are_what_they_are(tmp_path: Path) -> None:
    proc = namespace(tmp_path, INITIAL_NAMESPACE)
    process(proc, 7, 1111, "detector", [7])
    pids = PidMap(proc=proc)
    assert pids.knows
    assert pids.translate(7) == (ProcessKey(7, 1111), "detector -m serve")
    assert pids.translate(8) == (ProcessKey(8, 0), ""), "gone meanwhile"


def test_a_kernel_without_pid_namespaces_is_a_host(tmp_path: Path) -> None:
    process(tmp_path, 7, 1111, "detector", [7])
    assert PidMap(proc=tmp_path).translate(7)[0] == ProcessKey(7, 1111)


def test_in_a_container_a_host_pid_leads_to_one_of_ours(container: tuple[Path, Path]) -> None:
    own, host = container
    assert PidMap(host_proc=host, proc=own).translate(500) == (
        ProcessKey(7, 1111),
        "detector -m serve",
    )


def test_in_a_container_a_name_that_ends_in_half_a_letter_makes_no_stowaway(
    container: tuple[Path, Path],
) -> None:
    """Regression: the kernel cuts names at 15 bytes, and `/proc/PID/stat` was decoded as text."""
    own, host = container
    for stat in (own / "7" / "stat", host / "500" / "stat"):
        stat.write_bytes(stat.read_bytes().replace(b"detector", b"abcdefghijklmn\xc3"))
    assert PidMap(host_proc=host, proc=own).translate(500)[0] == ProcessKey(7, 1111)


def test_in_a_container_others_are_never_taken_for_one_of_ours(
    container: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    own, host = container
    pids = PidMap(host_proc=host, proc=own)
    with caplog.at_level(logging.WARNING):
        assert pids.translate(7) == (ProcessKey(-7, 0), "host pid 7 Xorg -m serve")
        assert pids.translate(600)[0] == ProcessKey(-600, 0), (
            "7 in its own container, but another process"
        )
        assert pids.translate(600)[0] == ProcessKey(-600, 0)
        assert pids.translate(999) == (ProcessKey(-999, 0), "host pid 999")
    assert [record.message.split(":")[0] for record in caplog.records] == ["pid_unmapped"] * 3, (
        "once each"
    )


def test_in_a_container_without_the_hosts_proc_lists_are_no_evidence(
    container: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        assert not PidMap(proc=container[0]).knows
    (record,) = caplog.records
    assert "gpu.host_proc" in record.message


def test_an_operator_may_know_better(container: tuple[Path, Path]) -> None:
    own, host = container
    assert PidMap("own", host, own).translate(7)[0] == ProcessKey(7, 1111), (
        "the driver counts as we do"
    )
    namespace(host, INITIAL_NAMESPACE)
    assert PidMap("host", host, host).translate(500)[0] == ProcessKey(-500, 0)


def test_this_very_process_is_found_with_the_real_proc() -> None:
    key, name = PidMap("own").translate(os.getpid())
    assert key.pid == os.getpid()
    assert key.start_ticks > 0
    assert "py" in name


def test_a_name_that_is_cut_in_the_middle_of_a_letter_hides_no_start_time(
    half_a_letter: int,
) -> None:
    """Regression: the kernel cuts names at 15 bytes, and `/proc/PID/stat` was decoded as text."""
    key, _ = PidMap("own").translate(half_a_letter)
    assert key == ProcessKey(half_a_letter, start_ticks(half_a_letter) or 0)
    assert key.start_ticks > 0
