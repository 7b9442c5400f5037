"""The budget for parked weights: the operator's word, else half of what the kernel calls available,
else nothing."""

from pathlib import Path

from vram_arbiter.arbiter.host.memory import available_bytes, park_budget_bytes
from vram_arbiter.schemas.defaults import KIB


def test_half_of_what_is_available(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       16000000 kB\nMemFree:  1 kB\nMemAvailable:   8000000 kB\n")
    assert available_bytes(meminfo) == 8_000_000 * KIB
    assert park_budget_bytes(None, meminfo) == 4_000_000 * KIB
    assert park_budget_bytes(0, meminfo) == 0
    assert park_budget_bytes(7, meminfo) == 7


def test_unknown_is_nothing(tmp_path: Path) -> None:
    assert park_budget_bytes(None, tmp_path / "missing") == 0
    (tmp_path / "odd").write_text("MemTotal: 1 kB\n")
    assert park_budget_bytes(None, tmp_path / "odd") == 0


def test_this_machine_says() -> None:
    assert available_bytes() > 0
