"""The boxes of a fleet on real raylets: agents and arbiters that die or stand still, and an actor
that moves on."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from tests.support.boxes import Boxes
from tests.support.episodes import Player
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.ray import Fleet, Reason, View, leased
from vram_arbiter.clients.ray import agent as agents
from vram_arbiter.clients.ray.fleet import _options, connected
from vram_arbiter.clients.ray.refusals import refuse_bytes, refuse_open
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import (
    ArbiterUnreachable,
    BadRequest,
    ConfigError,
    NotPermitted,
    VramInsufficient,
)

raylets = pytest.mark.nightly
pytestmark = [pytest.mark.heavy, pytest.mark.timeout(600)]


@leased(vram="6GiB", model="waits", wait_s=3)
class Waits:
    lease: Any

    def load(self) -> None: ...

    def unload(self) -> None: ...

    def pid(self) -> int:
        return os.getpid()


# -- without raylets
def test_a_cluster_that_is_open_to_its_network_is_refused() -> None:
    refuse_open(["127.0.0.1", "::1"], token=False)
    refuse_open(["192.0.2.7"], token=True)
    with pytest.raises(NotPermitted, match=r"192\.0\.2\.7 without authentication"):
        refuse_open(["127.0.0.1", "192.0.2.7"], token=False)


def test_bytes_that_a_node_announces_are_refused() -> None:
    refuse_bytes("box", ["CPU", "GPU", "memory", "accelerator_type:A100", "vram_arbiter"])
    for name in ("vram_bytes", "VRAM", "gpu_memory"):
        with pytest.raises(BadRequest, match=f"node box announces '{name}'"):
            refuse_bytes("box", [name])


def test_gpus_and_bytes_beside_a_lease_are_refused() -> None:
    import ray

    spec, options = _options(ray.remote(Player))
    assert spec is not None
    assert options["num_cpus"] == 0
    assert _options(ray.remote(num_gpus=1)(Event))[0] is None
    for beside in ({"num_gpus": 1}, {"resources": {"vram_bytes": 1}}):
        with pytest.raises(BadRequest, match="beside @leased"):
            _options(ray.remote(**beside)(Player))


def test_a_fleet_needs_a_connection() -> None:
    with pytest.raises(ConfigError, match="no connection to Ray"):
        Fleet().__enter__()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.0.0.1:port"])
def test_an_address_without_a_cluster_is_refused_at_once(address: str) -> None:
    """Ray itself tries for minutes."""
    with pytest.raises(ArbiterUnreachable, match=f"no Ray cluster answers at {address}: "):
        connected(address).__enter__()


# -- with raylets
@pytest.fixture
def fleet(boxes: Boxes) -> Iterator[Fleet]:
    with Fleet() as fleet:
        until(lambda: None not in fleet.views().values())
        yield fleet


def agent_pid(node: str) -> int:
    import ray

    actor = ray.get_actor(agents._name(node), namespace=agents.NAMESPACE)
    pid: int = ray.get(actor.__ray_call__.remote(lambda self: os.getpid()))
    return pid


def known(fleet: Fleet, node: str) -> View | None:
    return fleet.views()[node]


@raylets
def test_every_box_is_ranked_by_what_its_arbiter_says(boxes: Boxes, fleet: Fleet) -> None:
    first, second = boxes.nodes
    with Client("other", endpoint=first.daemon.endpoint) as arbiter:
        arbiter.acquire(vram="4GiB", model="other", unload=lambda: None).ready()
        ranked = fleet.order(6 * GIB, "pi0")
        assert [(one.box, one.reason) for one in ranked] == [
            ("n1", Reason.FREE),
            ("n0", Reason.EVICTABLE),
        ]
        assert [one.node for one in ranked] == [second.node_id, first.node_id]
    with pytest.raises(VramInsufficient, match="pi0 needs 20 GiB, and the greatest budget is"):
        fleet.order(20 * GIB, "pi0")


@raylets
def test_a_killed_agent_is_started_again(boxes: Boxes, fleet: Fleet) -> None:
    node = boxes.nodes[1].node_id
    before = agent_pid(node)
    os.kill(before, signal.SIGKILL)
    until(lambda: known(fleet, node) is None)
    until(lambda: known(fleet, node) is not None)
    assert agent_pid(node) != before


@raylets
def test_a_frozen_agent_leaves_its_box_unknown(
    boxes: Boxes, fleet: Fleet, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    node = boxes.nodes[1].node_id
    pid = agent_pid(node)
    os.kill(pid, signal.SIGSTOP)
    try:
        assert known(fleet, node) is None
        with Fleet() as another:  # which does not wait for it as for one that starts
            places = {one.node: one.reason for one in another.order(GIB, "pi0")}
            assert len(another.spread(Player, str(tmp_path), 0.0)) == 1
        assert places == {boxes.nodes[0].node_id: Reason.FREE, node: Reason.UNKNOWN}
        assert "no actor on n1: unknown" in caplog.text
    finally:
        os.kill(pid, signal.SIGCONT)
    until(lambda: known(fleet, node) is not None)
    assert agent_pid(node) == pid


@raylets
def test_a_daemon_is_restarted_under_its_agent(boxes: Boxes, fleet: Fleet) -> None:
    box = boxes.nodes[1]
    pid = agent_pid(box.node_id)
    box.daemon.kill()
    until(lambda: known(fleet, box.node_id) is None)
    box.daemon.start()
    until(lambda: known(fleet, box.node_id) is not None)
    assert agent_pid(box.node_id) == pid


@raylets
def test_an_actor_whose_wait_ends_is_placed_on_the_next_box(boxes: Boxes, fleet: Fleet) -> None:
    """The first box seems evictable, but its holder stays; the second is busy until then."""
    import ray

    first, second = boxes.nodes
    leave = Event()
    with (
        Client("stuck", endpoint=first.daemon.endpoint) as stuck,
        Client("busy", endpoint=second.daemon.endpoint) as busy,
        ThreadPoolExecutor(1) as pool,
    ):
        stuck.acquire(vram="6GiB", model="a", unload=lambda: leave.wait(PATIENCE_S)).ready()
        lease = busy.acquire(vram="6GiB", model="b", unload=lambda: None)
        lease.ready()
        with lease.use():
            order = [(one.box, one.reason) for one in fleet.order(6 * GIB, "waits")]
            assert order == [("n0", Reason.EVICTABLE), ("n1", Reason.BUSY)]
            placing = pool.submit(fleet.place, Waits)
            until(lambda: placing.done() or busy.status().totals.waiting == 1)
            assert not placing.done(), placing.exception()
            waited = [one.consumer for one in stuck.status().leases if one.state == "queued"]
            assert waited == []
        actor = placing.result(PATIENCE_S)
        held = [one.model for one in busy.status().leases if one.state == "held"]
        assert "waits" in held
        assert ray.get(actor.pid.remote()) > 0
        leave.set()
        ray.kill(actor)
    until(lambda: all(view and not view.resident for view in fleet.views().values()))


@raylets
def test_the_command_line_shows_all_boxes(boxes: Boxes, fleet: Fleet) -> None:
    def run(*words: str) -> tuple[int, Any]:
        done = subprocess.run(
            [sys.executable, "-m", "vram_arbiter.clients", "fleet", *words, "--ray", boxes.address],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.stdout, done.stderr
        return done.returncode, done.stdout

    with Client("waiting", endpoint=boxes.nodes[0].daemon.endpoint) as arbiter:
        arbiter.acquire(vram="2GiB", model="pi0", unload=lambda: None).ready()
        code, told = run("status", "--json")
        assert code == 0
        assert {one["box"]: one["view"]["resident"] for one in json.loads(told)["boxes"]} == {
            "n0": {"pi0": "held"},
            "n1": {},
        }
        code, told = run("place", "--vram", "5GiB", "--model", "pi0")
        assert code == 0
        assert told.startswith("1. n0: pi0 is resident there, and another copy fits: ")
        assert "\n2. n1: it fits: " in told
        code, told = run("why", "waiting")
        assert code == 0
        assert told.startswith("n0:\n  waiting: it is resident, ")
        assert run("why", "nobody")[0] == 1


@raylets
def test_a_dead_node_is_no_box_any_more(boxes: Boxes, fleet: Fleet, tmp_path: Path) -> None:
    first, second = boxes.nodes
    boxes.kill(second.name)
    until(lambda: list(fleet.views()) == [first.node_id])
    (actor,) = fleet.spread(Player, str(tmp_path), 0.0)
    assert actor is not None
