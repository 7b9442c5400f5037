"""`make bench-fleet`: what a lease adds to an actor's call, how episodes scale with boxes, and how
long a killed node, a killed actor and a silent network take.

Real raylets on one machine, each with an arbiter and a simulated GPU. Prints a table and writes
`out/bench/fleet.json` (`harness.Row` says what the fields mean).
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tests.bench.harness import Suite, elapsed_us, in_turns, p50, pause, summed
from tests.bench.tunnel import tunnel_rows
from tests.e2e.test_guests import policy_server, seconds_until_the_grant, uses
from tests.support.boxes import Box, Boxes
from tests.support.episodes import Bare, BareAsync, Caller, CallerAsync, SmallPlayer
from tests.support.guests import sshd_server
from tests.support.process import ArbiterProcess
from tests.support.sshd import unavailable
from tests.support.waiting import until
from vram_arbiter.clients.ray import Fleet, Result
from vram_arbiter.clients.ray.mapping import map_results
from vram_arbiter.clients.sync import Client
from vram_arbiter.testing.gpu import FakeGpu

CALLS = {"sync": (Bare, Caller, 1.2), "async": (BareAsync, CallerAsync, 0.7)}
"""Actors without and with a lease, and how many ms it may add to a call's median."""
APART_S = 0.05
"""A pause after which a call does not share the use of the one before."""
SEEDS, EPISODE_S, PER_NODE = 40, 0.5, 2
SCALING = {2: 0.95, 4: 0.9}
KILLED_AT = 12
DEADLINE_S = 120.0
REPLACED_S, BACK_S, SILENT_S = 30.0, 0.3, 5.0
BY_SSH = ("tunnel", "silent-network")
"""Subjects that start an sshd."""


@contextmanager
def boxes_of(nodes: int) -> Iterator[tuple[Boxes, Fleet]]:
    with (
        tempfile.TemporaryDirectory(prefix="b") as folder,
        Boxes(Path(folder), nodes=nodes) as boxes,
    ):
        boxes.connect()
        with Fleet() as fleet:
            yield boxes, fleet


def actors_of(
    fleet: Fleet, box: Box, cls: type, *arguments: object, per_node: int = 1
) -> list[Any]:
    """Actors of a box, loaded if they are leased."""
    import ray

    actors = fleet.spread(cls, *arguments, per_node=per_node, nodes=[box.node_id])
    ray.get([actor.ping.remote() for actor in actors])
    return actors


def calls(suite: Suite) -> None:
    """A leased actor's calls less a bare one's, one after the other and apart."""
    import ray

    def call(actor: Any, apart_s: float) -> Callable[[], float]:
        def once() -> float:
            pause(apart_s)
            return elapsed_us(lambda: ray.get(actor.ping.remote()))

        return once

    with boxes_of(1) as (boxes, fleet):
        (box,) = boxes.nodes
        for kind, (bare, leased, at_most_ms) in CALLS.items():
            (actor,), (leased_actor,) = actors_of(fleet, box, bare), actors_of(fleet, box, leased)
            actors = {"bare": actor, "leased": leased_actor}
            for name, apart_s, rounds in (("", 0.0, 2000), (", 50 ms apart", APART_S, 200)):
                timed = {one: call(actor, apart_s) for one, actor in actors.items()}
                found = in_turns(suite.size(rounds, rounds // 10), timed)
                for one, samples in found.items():
                    suite.time(f"{kind} call of a {one} actor{name}", samples)
                added_ms = (p50(found["leased"]) - p50(found["bare"])) / 1000
                suite.figure(f"{kind}: leased less bare{name}", added_ms, "ms", at_most=at_most_ms)


def scaling(suite: Suite) -> None:
    """The same sleeping episodes on 1, 2 and 4 boxes."""
    took: dict[int, float] = {}
    with (
        boxes_of(max(SCALING)) as (boxes, fleet),
        tempfile.TemporaryDirectory(prefix="b") as folder,
    ):
        players = [
            actors_of(fleet, box, SmallPlayer, folder, EPISODE_S, per_node=PER_NODE)
            for box in boxes.nodes
        ]
        for nodes in (1, *SCALING):
            actors = [actor for mine in players[:nodes] for actor in mine]
            began = time.monotonic()
            played(actors, Path(folder) / f"{nodes}")
            took[nodes] = time.monotonic() - began
            ideal_s = SEEDS * EPISODE_S / len(actors)
            note = f"{ideal_s / took[nodes]:.1%} of ideal"
            suite.figure(f"{SEEDS} episodes on {nodes} boxes", took[nodes], "s", note=note)
    for nodes, at_least in SCALING.items():
        ratio = took[1] / (nodes * took[nodes])
        suite.figure(f"scaling to {nodes} boxes", ratio, "of ideal", at_least=at_least)


def played(
    actors: Sequence[Any], out: Path, seen: Callable[[int], object] = lambda count: None
) -> int:
    """Play all seeds; how many have a result. `seen` is told their number after each."""
    count = 0

    def note(_: Result) -> None:
        nonlocal count
        count += 1
        seen(count)

    for _ in map_results(actors, "episode", range(SEEDS), out, DEADLINE_S, note):
        pass
    return count


def node_death(suite: Suite) -> None:
    with boxes_of(2) as (boxes, fleet), tempfile.TemporaryDirectory(prefix="b") as folder:
        spread = [actors_of(fleet, box, SmallPlayer, folder, EPISODE_S) for box in boxes.nodes]
        actors = [actor for (actor,) in spread]
        killed_at = 0.0

        def seen(count: int) -> None:
            nonlocal killed_at
            if count == KILLED_AT:
                boxes.kill(boxes.nodes[1].name)
                killed_at = time.monotonic()

        count = played(actors, Path(folder) / "out", seen)
        late_s = time.monotonic() - killed_at
        name = f"results after a node's death at {KILLED_AT} of {SEEDS}"
        suite.figure(name, count, "results", at_least=SEEDS)
        suite.figure("node killed -> last result", late_s, "s", at_most=REPLACED_S)


def bytes_back(suite: Suite) -> None:
    """From `ray.kill` until the arbiter has measured the model's bytes free."""
    import ray

    samples = []
    with boxes_of(1) as (boxes, fleet), tempfile.TemporaryDirectory(prefix="b") as folder:
        (box,) = boxes.nodes
        FakeGpu(box.gpu_folder).edit(release_lag_s=0.0)
        with Client("bench", endpoint=box.daemon.endpoint) as arbiter:
            for _ in range(suite.size(5, 2)):
                (actor,) = actors_of(fleet, box, SmallPlayer, folder, 0.0)
                began = time.monotonic()
                ray.kill(actor)
                until(lambda: not arbiter.status().leases)
                samples.append(time.monotonic() - began)
    suite.figure("ray.kill -> bytes verified back, median", p50(samples), "s", at_most=BACK_S)


def silent_network(suite: Suite) -> None:
    """From the last packet of a robot behind ssh to the grant of the model that waited for its use
    to end."""
    with ExitStack() as stack:

        def make(*arguments: Any, **named: Any) -> ArbiterProcess:
            daemon = ArbiterProcess(*arguments, **named)
            stack.callback(daemon.close)
            return daemon

        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="b"))
        there = stack.enter_context(sshd_server(make, Path(folder), network=True))
        policy, lease = stack.enter_context(policy_server(there))
        _, endpoint = stack.enter_context(there.tunnel())
        robot = stack.enter_context(Client("arm1", endpoint=endpoint))
        stack.enter_context(robot.use(lease.lease_id, lease.token, "goal"))
        until(lambda: uses(policy, lease) == 1)
        took_s = seconds_until_the_grant(there, policy, lease, there.sshd.silence)
    suite.figure("network silent -> other model granted", took_s, "s", at_most=SILENT_S)


SUBJECTS = {
    "calls": calls,
    "scaling": scaling,
    "node-death": node_death,
    "bytes-back": bytes_back,
    "tunnel": tunnel_rows,
    "silent-network": silent_network,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer calls")
    parser.add_argument(
        "--only", action="append", choices=SUBJECTS, help="one subject; may be repeated"
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench/fleet.json"))
    options = parser.parse_args()
    suite = Suite(quick=options.quick)
    for name in options.only or SUBJECTS:
        if name in BY_SSH and (why := unavailable()):
            suite.skipped(name, why)
            continue
        began = time.monotonic()
        SUBJECTS[name](suite)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    suite.write(options.out)
    print(f"{suite.table()}\n{summed(row.ok for row in suite.rows)}; rows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
