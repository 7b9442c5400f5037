"""Constants of the parts, from the configuration. The budget for parked weights: the operator's
word, else half of what the kernel calls available, else nothing."""

from dataclasses import fields
from pathlib import Path

from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.settings import park_budget_bytes
from vram_arbiter.schemas.config.arbiter import ArbiterConfig
from vram_arbiter.schemas.defaults import KIB
from vram_arbiter.schemas.runtime.connection import Bounds


def test_each_constant_of_the_configuration_reaches_a_part() -> None:
    """They are matched by name: a key of another name would have no effect."""
    names = {field.name for cls in (Settings, SessionSettings, Bounds) for field in fields(cls)}
    config = dict(ArbiterConfig())
    unused = [
        f"{section}.{key}"
        for section in ("scheduling", "revoke", "verify", "probe", "lease", "limits")
        for key, _ in config[section]
        if not {key, f"{section}_{key}"} & names
    ]
    assert unused == ["probe.deadline_s"], "it is given by hand"


def meminfo(root: Path, text: str) -> Path:
    (root / "proc").mkdir(exist_ok=True)
    (root / "proc" / "meminfo").write_text(text)
    return root


def test_half_of_what_is_available(tmp_path: Path) -> None:
    told = "MemTotal:       16000000 kB\nMemFree:  1 kB\nMemAvailable:   8000000 kB\n"
    root = meminfo(tmp_path, told)
    assert park_budget_bytes(None, root) == 4_000_000 * KIB
    assert park_budget_bytes(0, root) == 0
    assert park_budget_bytes(7, root) == 7


def test_unknown_is_nothing(tmp_path: Path) -> None:
    assert park_budget_bytes(None, tmp_path / "missing") == 0
    assert park_budget_bytes(None, meminfo(tmp_path, "MemTotal: 1 kB\n")) == 0


def test_this_machine_says() -> None:
    assert park_budget_bytes(None) > 0
