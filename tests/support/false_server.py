"""A process of another user that listens where a server of ours should: `python false_server.py
FOLDER NAME UID`.

It tells each message that it gets as a line on stdout, and answers every one with `ok`. It ends
when its stdin does.
"""

import os
import selectors
import sys

import msgpack
import zmq


def main() -> int:
    folder, name, uid = sys.argv[1], sys.argv[2], int(sys.argv[3])
    os.chdir(folder)  # the folders above it need not be open to that user
    os.setgid(uid)
    os.setuid(uid)
    socket = zmq.Context().socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.bind(f"ipc://{name}")
    print("listening", flush=True)
    watched = selectors.DefaultSelector()
    watched.register(socket.fileno(), selectors.EVENT_READ)
    watched.register(sys.stdin.fileno(), selectors.EVENT_READ)
    while True:
        while socket.poll(0):
            *envelope, payload = socket.recv_multipart()
            message = msgpack.unpackb(payload, strict_map_key=False)
            print(f"heard {message}", flush=True)
            answer = {
                "re": message.get("id"),
                "ok": True,
                "epoch": 1,
                "message": "the motors hold",
                "phase": "serving",
                "uptime_s": 1.0,
                "clients": 1,
                "gpus": [],
                "leases": [],
            }
            socket.send_multipart([*envelope, msgpack.packb(answer)])
        if any(key.fd == sys.stdin.fileno() for key, _ in watched.select()):
            os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
