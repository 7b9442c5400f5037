"""Results of numbered work: the first commit of a seed wins."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from vram_arbiter.clients.results import commit, committed
from vram_arbiter.schemas.errors import ConfigError


def test_the_first_result_of_a_seed_stays(tmp_path: Path) -> None:
    assert commit(tmp_path / "out", 7, {"value": 1})
    assert not commit(tmp_path / "out", 7, {"value": 2})
    assert commit(tmp_path / "out", 3, {"value": 3})
    assert list(committed(tmp_path / "out").items()) == [(3, {"value": 3}), (7, {"value": 1})]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "00003.json",
        "00007.json",
    ]


def test_one_of_many_wins(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda n: commit(tmp_path, 0, {"by": n}), range(64)))
    assert won.count(True) == 1
    assert committed(tmp_path) == {0: {"by": won.index(True)}}


def test_what_json_cannot_say_is_not_committed(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        commit(tmp_path, 0, {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_broken_result_is_named(tmp_path: Path) -> None:
    (tmp_path / "00001.json").write_text("{")
    with pytest.raises(ConfigError, match=r"00001\.json"):
        committed(tmp_path)
