"""The fleet of tests itself: each node has an arbiter of its own, and all ends with the block."""

from pathlib import Path

import pytest

from tests.support.boxes import Boxes
from tests.support.processes import alive
from tests.support.waiting import until
from vram_arbiter.testing.timeline import Timeline

pytestmark = [pytest.mark.heavy, pytest.mark.nightly]


def test_each_node_has_its_arbiter_and_all_ends_with_the_block(short_folder: Path) -> None:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    from vram_arbiter.clients.sync import Client

    def hold(name: str) -> None:
        with Client(name) as arbiter:
            arbiter.acquire(vram="1GiB", model=name).give_up()

    with Boxes(short_folder, nodes=2) as boxes:
        boxes.connect()
        for box in boxes.nodes:
            on = NodeAffinitySchedulingStrategy(box.node_id, soft=False)
            held = ray.remote(hold).options(num_cpus=0, scheduling_strategy=on).remote(box.name)
            ray.get(held)
            (granted,) = Timeline(box.daemon).events("granted")
            assert granted["consumer"] == box.name
        first, second = boxes.nodes
        pids = [*first.pids, *second.pids, first.daemon.pid, second.daemon.pid]
        with pytest.raises(ValueError, match="head"):
            boxes.kill(first.name)
        boxes.kill(second.name)
        assert not alive(second.daemon.pid)
        until(lambda: [one["NodeID"] for one in ray.nodes() if one["Alive"]] == [first.node_id])
    assert not any(map(alive, pids))
