"""Many at once: ten thousand live leases, ten thousand waiters' memory, ten thousand connections
that vanish in one moment, a flood."""

import resource
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack

from tests.bench.harness import (
    ANSWER_TIMEOUT_S,
    SHIPPED,
    Peer,
    Suite,
    arbiter,
    elapsed_us,
    end,
    helper,
    in_turns,
    p99,
    pause,
    spawn,
)
from tests.support.processes import rss_bytes

PER_CONNECTION = 128
CROWD_PROCESSES = 4
CALM_PAUSE_S = 0.002
"""Between a calm client's requests: it stays below the rate limit."""


def run(suite: Suite) -> None:
    live_leases(suite)
    waiters_memory(suite)
    disconnects(suite)
    under_a_flood(suite)


def live_leases(suite: Suite) -> None:
    """Two daemons side by side: one holds one small lease, the other ten thousand."""
    many, rounds = suite.size(10_000, 1000), suite.size(1000, 100)
    with ExitStack() as stack:
        calls = {}
        for count in (1, many):
            daemon = stack.enter_context(arbiter())
            for start in range(0, count, PER_CONNECTION):
                holder = Peer(daemon.endpoint, f"holder{start}").greeted()
                stack.callback(holder.close)
                for _ in range(min(PER_CONNECTION, count - start)):
                    holder.ready(holder.lease())
            peer = Peer(daemon.endpoint, "cycle").greeted()
            stack.callback(peer.close)
            calls[f"{count}"] = cycle_of(peer)
        found = in_turns(rounds, calls)
    suite.time("acquire + release beside 1 live lease", found["1"])
    name = f"acquire + release beside {many} live leases"
    suite.compare(name, found[f"{many}"], found["1"], "1 live lease", 1.15)


def cycle_of(peer: Peer) -> Callable[[], float]:
    return lambda: elapsed_us(lambda: peer.release(peer.lease()))


def waiters_memory(suite: Suite) -> None:
    many = suite.size(10_000, 2000)
    with ExitStack() as stack:
        daemon = stack.enter_context(arbiter())
        first = Peer(daemon.endpoint, "loader").greeted()
        stack.callback(first.close)
        first.lease()  # it loads for ever
        peers = [
            Peer(daemon.endpoint, f"w{n}").greeted() for n in range(-(-many // PER_CONNECTION))
        ]
        for peer in peers:
            stack.callback(peer.close)
        fill_history(first)
        before = rss_bytes(daemon.pid)
        for number in range(many):
            peer = peers[number // PER_CONNECTION]
            peer.reply(peer.want())
        grown = rss_bytes(daemon.pid) - before
    name = f"memory per waiter, of {many}"
    suite.figure(
        name, grown / many / 1024, "KB", at_most=4.0, note="as the daemon's resident set grows"
    )


def fill_history(peer: Peer) -> None:
    """The newest facts and the newest ended leases are kept in memory whoever waits; they are no
    cost of a waiter."""
    for _ in range(1200):
        lease = peer.reply(peer.want())["lease"]
        peer.ask("cancel", lease_id=lease["lease_id"])


def disconnects(suite: Suite) -> None:
    """Processes with thousands of connections, each of which waits, are killed in one moment.

    The daemon takes as many connections as its open files allow (`settings.router_limits`).
    """
    open_files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    most = 10_000 if open_files == resource.RLIM_INFINITY else open_files // 4
    many = min(suite.size(10_000, 1000), most) // CROWD_PROCESSES * CROWD_PROCESSES
    with arbiter() as daemon:
        witness = Peer(daemon.endpoint, "witness").greeted()
        lease = witness.lease()
        fill_history(witness)
        before = rss_bytes(daemon.pid)
        crowd = []
        try:
            for _ in range(CROWD_PROCESSES):
                crowd.append(spawn("crowd.py", daemon.endpoint, str(many // CROWD_PROCESSES)))
            waiting = witness.ask("status")["totals"]["waiting"]
            began = time.perf_counter()
            for process in crowd:
                process.send_signal(signal.SIGKILL)
            forgotten = all_forgotten(witness)
            took_ms = (time.perf_counter() - began) * 1e3
            stays = rss_bytes(daemon.pid) - before
        finally:
            for process in crowd:
                process.kill()
                end(process)
        witness.ready(lease)
        witness.release(lease)
        after = [elapsed_us(lambda: witness.release(witness.lease())) for _ in range(20)]
        witness.close()
    survived = f"{many} simultaneous disconnects survived"
    whole = float(waiting == many and forgotten)
    suite.figure(
        survived, whole, "", at_least=1.0, note="1: every wait has ended, no invariant was violated"
    )
    suite.figure(f"{many} simultaneous disconnects: all forgotten after", took_ms, "ms")
    suite.time("acquire + release right after that", after)
    name = f"memory that stays when {many} waiters are gone"
    suite.figure(name, stays / 2**20, "MiB", at_most=16.0, note="of the daemon's resident set")


def all_forgotten(witness: Peer) -> bool:
    deadline = time.monotonic() + ANSWER_TIMEOUT_S
    while witness.ask("status")["totals"]["leases"] > 1:
        if time.monotonic() > deadline:
            return False
        pause(0.01)
    return True


def under_a_flood(suite: Suite) -> None:
    """A client's acquire + release while another sends as fast as its socket takes it. Limits as
    shipped."""
    rounds = suite.size(1500, 150)
    with arbiter(SHIPPED) as daemon:
        peer = Peer(daemon.endpoint, "calm").greeted()
        cycle = cycle_of(peer)

        def calm() -> float:
            pause(CALM_PAUSE_S)
            return cycle()

        quiet = in_turns(rounds, {"quiet": calm})["quiet"]
        with helper("flooder.py", daemon.endpoint):
            loud = in_turns(rounds, {"loud": calm})["loud"]
        peer.close()
    suite.time("acquire + release, nobody else there", quiet)
    name = "acquire + release under another's flood, by p99"
    suite.compare(name, loud, quiet, "quiet p99", 3.0, of=p99)
