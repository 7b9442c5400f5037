"""The storm's own hands: how it starts a daemon that a full disk keeps from starting."""

import asyncio
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest


class Arbiter:
    """Starts from the n-th try on, and may see the disk emptied while it fails."""

    def __init__(self, runtime: Path) -> None:
        self.runtime, self.state, self.gpu_folder = runtime, runtime / "state", runtime / "gpu"
        self.environ: dict[str, str] = {}
        self.pid = 2**22  # nobody has it
        self.starts = 0
        self.succeeds_at = 1
        self.emptied_meanwhile: Callable[[], None] = lambda: None

    def start(self) -> None:
        self.starts += 1
        if self.starts < self.succeeds_at:
            self.emptied_meanwhile()
            raise RuntimeError("the arbiter ended with 5")


@pytest.fixture
def storm_module() -> Iterator[ModuleType]:
    path = Path(__file__).with_name("storm.py")
    spec = importlib.util.spec_from_file_location("chaos_storm", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["chaos_storm"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["chaos_storm"]


@pytest.fixture
def storm(
    storm_module: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> SimpleNamespace:
    """`.run`: a storm that has started nothing; `.arbiter`: what it believes to be the daemon."""
    arbiter = Arbiter(tmp_path)
    monkeypatch.setattr(storm_module, "ArbiterProcess", lambda **_: arbiter)
    monkeypatch.setattr(storm_module.Storm, "_mount_state", lambda _: False)
    return SimpleNamespace(run=storm_module.Storm(1.0, 1, tmp_path), arbiter=arbiter)


def test_a_full_disk_is_emptied_for_a_start(storm: SimpleNamespace) -> None:
    storm.arbiter.succeeds_at = 2
    storm.run._disk_is_full = True
    asyncio.run(storm.run._start_daemon())
    assert storm.arbiter.starts == 2
    assert not storm.run._disk_is_full


def test_a_disk_that_is_emptied_while_a_start_fails_is_worth_another_try(
    storm: SimpleNamespace,
) -> None:
    """Regression (seed 11): the storm fell over with a start that had found the disk full."""
    storm.arbiter.succeeds_at = 2
    storm.run._disk_is_full = True
    storm.arbiter.emptied_meanwhile = storm.run._empty_disk
    asyncio.run(storm.run._start_daemon())
    assert storm.arbiter.starts == 2


def test_a_start_that_fails_on_a_good_disk_ends_the_storm(storm: SimpleNamespace) -> None:
    storm.arbiter.succeeds_at = 2
    with pytest.raises(RuntimeError, match="ended with 5"):
        asyncio.run(storm.run._start_daemon())
