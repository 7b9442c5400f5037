"""Other clients' requests while one process attacks the daemon, and the messages that cost its loop
the most. Limits as shipped."""

import time

from tests.bench.harness import SHIPPED, Peer, Suite, arbiter, elapsed_us, pause
from tests.support.attacks import ATTACKS
from tests.support.costly import COSTLY
from tests.support.running import attacked
from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES

CALM_PAUSE_S = 0.002
"""Between a calm client's requests: it stays below the rate limit."""
REQUEST_P99_MAX_US = 50_000
MESSAGE_MAX_US = 5_000


def run(suite: Suite) -> None:
    for name, message in COSTLY.items():
        samples = [cost_us(message) for _ in range(suite.size(50, 5))]
        suite.limit(
            f"a message, decoded: {name}", samples, p99_max_us=MESSAGE_MAX_US, note="processor time"
        )
    seconds = suite.size(10, 1)
    for name in ATTACKS:
        suite.limit(
            f"a request under {name}", requests_under(name, seconds), p99_max_us=REQUEST_P99_MAX_US
        )


def cost_us(message: bytes) -> float:
    """Processor time to decode a message, or to refuse it."""
    began_ns = time.thread_time_ns()
    try:
        codec.decode(message, MESSAGE_MAX_BYTES)
    except codec.Undecodable as bad:
        codec.refusal(bad.request_id, 1, bad.error.view())
    return (time.thread_time_ns() - began_ns) / 1000


def requests_under(attack: str, seconds: float) -> list[float]:
    """A ping and an acquire + release in turns, each timed."""
    samples = []
    with arbiter(SHIPPED) as daemon:
        peer = Peer(daemon.endpoint, "calm").greeted()
        with attacked(daemon.endpoint, attack, seconds):
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                pause(CALM_PAUSE_S)
                samples.append(elapsed_us(lambda: peer.ask("ping")))
                pause(CALM_PAUSE_S)
                samples.append(elapsed_us(lambda: peer.release(peer.lease())))
        peer.close()
    return samples
