"""One box: an agent answers, an actor loads under its lease, and a seed has its result."""

from pathlib import Path

import pytest

from tests.support.boxes import Boxes
from tests.support.episodes import Player
from vram_arbiter.clients.ray import Fleet, Reason, Result

pytestmark = [pytest.mark.heavy, pytest.mark.e2e]


def test_a_seed_is_played_on_a_box(short_folder: Path, tmp_path: Path) -> None:
    with Boxes(short_folder, nodes=1) as boxes:
        boxes.connect()
        (box,) = boxes.nodes
        with Fleet() as fleet:
            (actor,) = fleet.spread(Player, str(tmp_path), 0.0)
            (result,) = fleet.map([actor], "episode", [7], out=f"{tmp_path}/out", deadline_s=60.0)
            assert result == Result(7, box.node_id, result.value)
            assert result.value["seed"] == 7
            (view,) = fleet.views().values()
            assert (view.box, view.resident) == ("n0", {"episodes": "held"})
            (ranked,) = fleet.order(1 << 30, "episodes")
            assert (ranked.node, ranked.reason) == (box.node_id, Reason.RESIDENT)
