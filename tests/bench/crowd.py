"""Thousands of connections of one process, each with a lease that waits; says a line when all wait,
then sits until it is killed."""

import sys

import zmq

from tests.bench.harness import Peer

STEP = 100


def main(endpoint: str, count: int) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.set(zmq.MAX_SOCKETS, count + 16)
    peers: list[Peer] = []
    for start in range(0, count, STEP):
        some = [Peer(endpoint, f"c{start + n}", context) for n in range(min(STEP, count - start))]
        for peer, greeting in [(peer, peer.greet()) for peer in some]:
            peer.reply(greeting)
        for peer, want in [(peer, peer.want()) for peer in some]:
            assert peer.reply(want)["state"] == "queued"
        peers += some
    print("all wait", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
