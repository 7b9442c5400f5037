"""Servers of the field for tests: one REP socket and one thread, which answers one request after
the other in the field's own shapes. Written after their wire, not copied. Not a test module.

What a test asks decides what happens: the text `hang` is answered once `release` is set, `fail`
with the family's error, a key of `RAW` with those bytes, `list` with a list, `die` by closing the
socket. Else `answer` is the model's text, and `action` maps names to arrays.
"""

import io
import struct
import threading
from collections.abc import Callable
from typing import Any, Self

import msgpack
import zmq

RAW: dict[str, Callable[[], bytes]] = {
    "garbage": lambda: b"ERROR",
    "huge": lambda: b"\xc6" + bytes(64 << 20),
    "many": lambda: b"\xdd" + (70_000).to_bytes(4) + b"\xc0" * 70_000,
}
PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 200, 100)


def packed(value: Any) -> Any:
    """An array as the field's servers send it."""
    import numpy as np

    if isinstance(value, np.ndarray):
        stream = io.BytesIO()
        np.save(stream, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": stream.getvalue()}
    raise TypeError(type(value))


def unpacked(value: dict[str, Any]) -> Any:
    if "__ndarray_class__" in value:
        import numpy as np

        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    return value


class FieldServer:
    """`with FieldServer(endpoint) as server:` serves both families until the end of the block."""

    def __init__(self, endpoint: str, answer: str = "") -> None:
        self.answer = answer
        self.heard: list[dict[str, Any]] = []
        self.release = threading.Event()
        self.action: dict[str, Any] = {}
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, 20)
        self.endpoint = self._socket.bind(endpoint).addr
        self._ending = False
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self.release.set()
        self._thread.join()
        self._context.term()

    def _serve(self) -> None:
        try:
            self._answer()
        finally:  # the end of its context waits for it
            self._socket.close()

    def _answer(self) -> None:
        while not self._ending:
            try:
                request = msgpack.unpackb(self._socket.recv(), object_hook=unpacked)
            except zmq.Again:
                continue
            self.heard.append(request)
            asked = str(request.get("query", request.get("question", request.get("data"))))
            if "die" in asked:
                break
            if "hang" in asked:
                self.release.wait()
            if asked in RAW:
                self._socket.send(RAW[asked]())
                continue
            answer: Callable[..., Any] = self._endpoint if "endpoint" in request else self._op
            try:
                if "fail" in asked:
                    raise ValueError("as asked")
                reply = ["a", "list"] if "list" in asked else answer(**request)
            except Exception as error:  # noqa: BLE001  as theirs
                text = f"{type(error).__name__}: {error}"
                reply = {"error": text} if "endpoint" in request else {"ok": False, "error": text}
            self._socket.send(msgpack.packb(reply, default=packed))
            self._ending |= request.get("op", request.get("endpoint")) in ("shutdown", "kill")

    def _op(self, op: str, **fields: Any) -> Any:
        match op:
            case "ping":
                return {"ok": True, "model": "field/model"}
            case "detect":
                return {"ok": True, "answer": self.answer, "norm": 1000}
            case "query":
                return {"ok": True, "answer": f"{fields['question']} {len(fields['image'])}"}
            case "score":
                n, size = fields["n"], fields["width"] * fields["height"] * 3
                if len(fields["frames"]) != n * size:
                    raise ValueError("cannot reshape")
                blue = [fields["frames"][at * size] / 255 for at in range(n)]
                return {"ok": True, "progress": blue, "success": [0.0] * n}
            case "shutdown":
                return {"ok": True}
        return {"ok": False, "error": f"unknown op {op!r}"}

    def _endpoint(self, endpoint: str, data: dict[str, Any] | None = None, **_: Any) -> Any:
        match endpoint:
            case "ping":
                return {"status": "ok", "message": "Server is running"}
            case "get_action":
                return self._act(**(data or {}))
            case "reset":
                return self._reset(**(data or {}))
            case "kill":
                return None
        raise ValueError(f"Unknown endpoint: {endpoint}")

    def _act(self, observation: dict[str, Any], options: dict[str, Any] | None = None) -> Any:
        moved = {
            key.replace("state", "action"): value + 1
            for key, value in observation.items()
            if key.startswith("state.")
        }
        return [{**moved, **self.action}, {"options": options}]

    def _reset(self, options: dict[str, Any] | None = None) -> dict[str, Any]:
        return {"options": options}
