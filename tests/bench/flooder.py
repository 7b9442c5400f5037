"""A client that sends pings as fast as its socket takes them and reads what comes back. Ends with
its standard input."""

import sys
import threading

import msgpack
import zmq

from tests.bench.harness import Peer

BURST = 100


def main(endpoint: str) -> None:
    peer = Peer(endpoint, "flooder").greeted()
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    print("up", flush=True)
    payload = msgpack.packb({"op": "ping", "id": 9})
    while not ended.is_set():
        try:
            for _ in range(BURST):
                peer.socket.send(payload, zmq.NOBLOCK)
        except zmq.Again:
            pass
        try:
            while True:
                peer.socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            pass
    peer.close()


if __name__ == "__main__":
    main(sys.argv[1])
