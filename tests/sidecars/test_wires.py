"""The sidecars' wires: both families, REQ and DEALER peers, and everything that strangers
may send."""

import asyncio
import io
import os
import socketserver

import msgpack
import pytest
import zmq

from vram_arbiter.clients.net.server import Peer
from vram_arbiter.schemas.errors import CODES, BadRequest, ModelError, OutOfMemory, UnknownOp
from vram_arbiter.schemas.sidecar import PICTURES_MAX, DetectOp, EndpointCall, ScoreOp
from vram_arbiter.sidecars.wires import PENDING_MAX, Wire, parse, unread_reply

PNG = b"\x89PNG\r\n\x1a\n"
OPS = frozenset({"detect", "get_action", "reset", "score"})
PEER = Peer(1, 0, 0)


class Host:
    """Answers what it is asked; `gate` holds model calls back."""

    model_ops = OPS

    def __init__(self):
        self.gate = asyncio.Event()
        self.calls = []
        self.answer: object = {"ok": True}

    def identity(self):
        return {"ok": True, "state": "unloaded"}

    async def load(self, timeout_s):
        self.calls.append(("load", timeout_s))
        return {"ok": True, "lease_id": None, "token": None, "loaded": True}

    async def unload(self):
        self.calls.append(("unload",))

    async def run(self, name, call, message):
        self.calls.append((name, call))
        await self.gate.wait()
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def stop(self):
        self.calls.append(("stop",))


def talk(*messages, answer=None, peer=PEER):
    """Handle messages one after the other; returns the replies and the host."""

    async def run():
        host, replies = Host(), []
        host.gate.set()
        if answer is not None:
            host.answer = answer

        async def send(peer, message):
            replies.append(message)

        wire = Wire(host, send)
        for message in messages:
            await wire.handle(peer, message)
        return replies, host

    return asyncio.run(run())


def test_both_families_reach_the_host():
    replies, host = talk(
        {"op": "ping", "id": 7},
        {"endpoint": "ping"},
        {"op": "load", "timeout_s": 2.0, "traceparent": "00-1-2-03"},
        {"endpoint": "load", "data": {"timeout_s": 3}},
        {"op": "detect", "image": PNG, "query": "cube", "mode": "fast", "token": [1, 2]},
        {"endpoint": "get_action", "id": 8, "data": {"observation": {}}, "api_token": None},
        {"endpoint": "unload"},
        {"op": "shutdown"},
    )
    assert replies[0] == {"ok": True, "state": "unloaded", "re": 7}
    assert "re" not in replies[1], "REQ clients of the field send no id and expect none"
    assert all(reply["ok"] for reply in replies)
    names = [call[0] for call in host.calls]
    assert names == ["load", "load", "detect", "get_action", "unload", "stop"]
    assert [call[1] for call in host.calls[:2]] == [2.0, 3]
    assert isinstance(host.calls[2][1], DetectOp)
    assert host.calls[2][1].token == (1, 2)
    assert isinstance(host.calls[3][1], EndpointCall)


def test_others_of_the_group_do_not_end_it():
    """A robot behind ssh ended the model of all robots."""
    own, behind_its_port = os.getuid(), os.getpid()
    for peer, ends in (
        (Peer(1, 7, 0), True),
        (Peer(1, 7, own), True),
        (Peer(1, 7, 54_321), False),
        (Peer(1, behind_its_port, own), False),
    ):
        (reply,), host = talk({"op": "shutdown"}, peer=peer)
        assert (reply["ok"], host.calls) == ((True, [("stop",)]) if ends else (False, []))
        assert ends or reply["code"] == "not_permitted"


@pytest.mark.parametrize(
    ("message", "code", "told"),
    [
        ({}, "bad_request", "needs an op or endpoint"),
        ({"op": 5}, "bad_request", "needs an op or endpoint"),
        ({"op": "dance"}, "unknown_op", "dance"),
        ({"op": "query", "image": PNG, "question": "?"}, "unknown_op", "query"),
        ({"endpoint": "detect", "data": {}}, "bad_request", "detect: endpoint"),
        ({"op": "get_action"}, "bad_request", "get_action"),
        ({"op": "detect"}, "bad_request", "image"),
        ({"op": "detect", "image": "text", "query": "x", "colour": 1}, "bad_request", "colour"),
        ({"op": "detect", "image": PNG, "query": ""}, "bad_request", "query.text: String should"),
        ({"op": "detect", "image": PNG, "query": []}, "bad_request", "query.list: List should"),
        ({"op": "detect", "image": PNG, "query": ["cup"] * 200}, "bad_request",
         "query.list: List should have at most 64 items after validation, not 200"),
        ({"op": "detect", "image": PNG, "query": ["cup", 1]}, "bad_request", "query.list.1: Input"),
        ({"op": "detect", "image": PNG, "query": "x", "max_side": 10**9}, "bad_request",
         "max_side"),
        ({"op": "detect", "image": PNG, "query": "x", "token": [1]}, "bad_request", "token"),
        ({"op": "detect", "image": PNG, "query": "x", "score_threshold": float("nan")},
         "bad_request", "score_threshold"),
        ({"op": "load", "timeout_s": -1}, "bad_request", "timeout_s"),
        ({"op": "load", "timeout_s": float("inf")}, "bad_request", "timeout_s"),
        ({"endpoint": "load", "data": {"timeout_s": "soon"}}, "bad_request",
         "load: data.timeout_s: "),
        ({"endpoint": "get_action", "data": [1]}, "bad_request", "data"),
        ({"op": "ping", "id": 1, "token": 7}, "bad_request", "token"),
        ({"endpoint": "get_action",
          "rtc": {"left_over": [], "inference_delay": 1, "execution_horizon": 1}},
         "bad_request", "left_over"),
    ],
)  # fmt: skip
def test_a_bad_message_gets_a_typed_error_that_names_the_field(message, code, told):
    (reply,), host = talk({"id": 1, **message})
    assert (reply.get("ok", False), reply["code"]) == (False, code)
    assert told in reply["error"] + str(reply["details"])
    assert host.calls == []


def test_the_known_ops_are_told():
    with pytest.raises(UnknownOp) as caught:
        parse({"op": "dance"}, OPS)
    assert caught.value.details["known"] == sorted({"load", "ping", "shutdown", "unload"} | OPS)


def npy(array, **options):
    import numpy as np

    stream = io.BytesIO()
    np.save(stream, array, **options)
    return {"__ndarray_class__": True, "as_npy": stream.getvalue()}


def picture_array():
    import numpy as np

    return np.zeros((1, 1, 8, 8, 3), np.uint8)


def test_arrays_go_both_ways_and_objects_never():
    np = pytest.importorskip("numpy")
    observation = {"state": npy(np.arange(3.0)), "task": "grab"}
    (reply,), host = talk(
        {"endpoint": "get_action", "data": {"observation": observation}, "id": 1},
        answer={"action": npy(np.zeros((2, 6), np.float32))},
    )
    assert (host.calls[0][1].data["observation"]["state"] == np.arange(3.0)).all()
    assert reply["action"]["__ndarray_class__"] is True
    assert msgpack.packb(reply), "nothing but plain values goes to the codec"
    shape = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    bomb = (b"\x93NUMPY\x01\x00v\x00" + shape).ljust(128, b" ")
    for bad in (
        npy(np.array([{"a": 1}], dtype=object), allow_pickle=True),
        {"__ndarray_class__": True, "as_npy": b"no array"},
        {"__ndarray_class__": True, "as_npy": "text"},
        {"__ndarray_class__": True, "as_npy": bomb},
    ):
        (reply,), host = talk({"endpoint": "get_action", "data": {"observation": {"state": bad}}})
        assert reply["error"].startswith("BadRequest: ")
        assert host.calls == []


@pytest.mark.parametrize(
    "error", [ModelError("no"), OutOfMemory("full", details={"free_bytes": 1}), BadRequest("what")]
)
def test_errors_of_the_model_keep_their_type(error):
    (reply,), _ = talk({"op": "detect", "image": PNG, "query": "x", "id": 3}, answer=error)
    assert reply == {
        "ok": False, "error": f"{type(error).__name__}: {error.message}", "code": error.code,
        "hint": "", "details": error.details,
        "message": error.message, "re": 3,
    }  # fmt: skip
    assert CODES[reply["code"]] is type(error)


def test_a_defect_of_ours_is_an_answer_too():
    (reply,), _ = talk(
        {"op": "detect", "image": PNG, "query": "x"}, answer=ZeroDivisionError("oops")
    )
    assert (reply["code"], reply["error"]) == ("internal", "InternalError: ZeroDivisionError: oops")


def test_too_many_waiting_requests_are_refused_and_ping_still_answers():
    async def run():
        host, replies = Host(), []

        async def send(peer, message):
            replies.append(message)

        wire = Wire(host, send)
        detect = {"op": "detect", "image": PNG, "query": "x"}
        waiting = [asyncio.create_task(wire.handle(PEER, detect)) for _ in range(PENDING_MAX)]
        await asyncio.sleep(0)
        await wire.handle(PEER, detect)
        await wire.handle(PEER, {"op": "ping"})
        assert [reply.get("code") for reply in replies] == ["limit_exceeded", None]
        host.gate.set()
        await asyncio.gather(*waiting)
        await wire.handle(PEER, detect)
        assert replies[-1]["ok"]

    asyncio.run(run())


def test_clients_of_the_field_get_their_familys_shapes():
    """The field's policy clients read a map of two keys as actions, and unpack a pair; both ended
    in a KeyError far from its cause. Its reward client reads the last of no values."""
    act = {"endpoint": "get_action", "data": {"observation": {}, "options": None}}
    replies, _ = talk(act, {**act, "id": 5}, answer={"action": [1.0]})
    assert replies == [[{"action": [1.0]}, {}], {"action": [1.0], "re": 5}]
    detect = {"op": "detect", "image": PNG, "query": "x"}
    error = ModelError("no", hint="try")
    replies, _ = talk(act, {"endpoint": "dance"}, {**act, "id": 5}, detect, answer=error)
    policy, unknown, ours, detector = replies
    assert policy == {"error": "ModelError: no (try)"}
    assert list(unknown) == ["error"]
    assert (ours["error"], ours["code"], ours["re"]) == ("ModelError: no", "model_error", 5)
    assert (detector["ok"], detector["error"]) == (False, "ModelError: no")
    replies, _ = talk(
        RAW, {**RAW, "id": 6}, answer={"ok": True, "progress": [0.5, 0.6], "success": []}
    )
    assert [reply["success"] for reply in replies] == [[0.0, 0.0], []]
    assert unread_reply(frozenset({"get_action", "reset"}))(error) == policy
    assert unread_reply(OPS)(error) == detector


# -- on a real socket
@pytest.mark.e2e
def test_req_clients_of_the_field_are_answered(lone_box):
    """Strict ones, and those that number their requests, which waited for ever; on a port, which is
    all that the field's clients can be told."""
    with socketserver.TCPServer(("127.0.0.1", 0), None) as free:
        port = free.server_address[1]
    lone_box.start("detector", "--no-arbiter", "--port", str(port), device="none")
    file, on_port = f"ipc://{lone_box.runtime}/detector.sock", f"tcp://127.0.0.1:{port}"
    detect = {"image": PNG, "query": "cube", "max_side": 512, "mode": "hybrid"}
    observation = {"video.image": npy(picture_array()), "annotation.task": ["grab"]}
    for endpoint, *options in (
        (on_port,),
        (file,),
        (file, zmq.REQ_CORRELATE),
        (on_port, zmq.REQ_CORRELATE, zmq.REQ_RELAXED),
    ):
        with zmq.Context.instance().socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVTIMEO, 60_000)
            for option in options:
                socket.setsockopt(option, 1)
            socket.connect(endpoint)

            def ask(socket=socket, **message):
                socket.send(msgpack.packb(message))
                return msgpack.unpackb(socket.recv())

            assert ask(op="ping")["ok"]
            assert ask(op="detect", max_new_tokens=1024, **detect)["answer"] == "cube"
            assert ask(op="detect", **detect | {"query": ""})["ok"] is False
            assert ask(endpoint="ping")["state"] == "resident"
            assert ask(endpoint="reset", data={"options": None}, api_token=None)["ok"]
            data = {"observation": observation, "options": None}
            actions, info = ask(endpoint="get_action", data=data, api_token=None)
            assert (actions["answer"], info) == ("get_action", {})
            refused = ask(endpoint="get_modality_config")
            assert list(refused) == ["error"]
            assert "unknown endpoint 'get_modality_config'" in refused["error"]


RAW = {
    "op": "score",
    "task": "t",
    "frames": bytes(2 * 3 * 4 * 3),
    "n": 2,
    "width": 4,
    "height": 3,
    "num_bins": 100,
}


def test_pictures_to_judge_come_as_the_field_sends_them_or_as_pngs():
    ops = frozenset({"score"})
    assert parse(RAW, ops) == ScoreOp(**RAW)
    assert parse({"op": "score", "images": [PNG, PNG]}, ops).images == [PNG, PNG]
    with pytest.raises(UnknownOp):
        parse(RAW, OPS - ops)


@pytest.mark.parametrize(
    "message",
    [
        {"op": "score", "task": "t"},
        {**RAW, "images": [PNG]},
        {**RAW, "n": 3},
        {**RAW, "width": None},
        {**RAW, "frames": b"x"},
        {**RAW, "n": 0, "frames": b""},
        {
            **RAW,
            "n": PICTURES_MAX + 1,
            "width": 1,
            "height": 1,
            "frames": bytes(3 * (PICTURES_MAX + 1)),
        },
        {"op": "score", "images": [PNG] * (PICTURES_MAX + 1)},
        {"op": "score", "images": [b"x"]},
        {"op": "score", "images": PNG},
        {"op": "score", "images": [PNG], "task": 7},
        {"op": "score", "images": [PNG], "num_bins": 1},
    ],
)
def test_pictures_that_do_not_add_up_are_refused(message):
    with pytest.raises(BadRequest, match="score: "):
        parse(message, frozenset({"score"}))
