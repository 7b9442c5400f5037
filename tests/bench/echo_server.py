"""The floor of the wire: a blocking ZeroMQ ROUTER that validates each request and answers. Ends
with its standard input."""

import sys
import threading

import msgpack
import zmq

from vram_arbiter.arbiter.rpc.codec import decode
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES

PAD = "x" * 160


def main(endpoint: str) -> None:
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.ROUTER)
    socket.bind(endpoint)
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    print("up", flush=True)
    while not ended.is_set():
        if socket.poll(50):
            client, frame = socket.recv_multipart()
            envelope, _ = decode(frame, MESSAGE_MAX_BYTES)
            body = {"re": envelope.id, "epoch": 1, "ok": True, "pad": PAD}
            socket.send_multipart([client, msgpack.packb(body)])
    socket.close(linger=0)


if __name__ == "__main__":
    main(sys.argv[1])
