"""SIGKILL of a holder: how long after its parent could reap it the next one is granted.

The victim holds the GPU's loading slot with nothing on the GPU yet, so the kernel's and the
driver's part is as small as it gets.
"""

import os
import signal
import time

from tests.bench.harness import Peer, Suite, arbiter, end, spawn


def run(suite: Suite) -> None:
    with arbiter() as daemon:
        survivor = Peer(daemon.endpoint, "survivor").greeted()
        samples = [kill(daemon.endpoint, survivor) for _ in range(suite.size(60, 8))]
        survivor.close()
    over = [granted for granted, _ in samples]
    name = "death of a holder: waitpid to the next grant"
    suite.limit(name, over, p50_max_us=1000.0, p99_max_us=10_000.0, note="p99 of 60 is the worst")
    suite.time(
        "death of a holder: SIGKILL to waitpid",
        [reaped for _, reaped in samples],
        "the kernel's part",
    )


def kill(endpoint: str, survivor: Peer) -> tuple[float, float]:
    """(waitpid → grant, SIGKILL → waitpid) in microseconds."""
    victim = spawn("holder.py", endpoint)
    try:
        assert survivor.reply(survivor.want())["state"] == "queued"
        start = time.perf_counter()
        os.kill(victim.pid, signal.SIGKILL)
        victim.wait()
        reaped = time.perf_counter()
        lease = survivor.push("granted")["lease"]
        granted = time.perf_counter()
        survivor.release(lease)
    finally:
        end(victim)
    return (granted - reaped) * 1e6, (reaped - start) * 1e6
