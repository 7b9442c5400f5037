"""Our clients and the servers of the field: REP sockets, which answer in order, without `re`, and
in their own shapes. None of their operations worked."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.field_server import PNG, FieldServer
from tests.support.pictures import encoded
from tests.support.serving import answering
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.sidecar.field import grounded
from vram_arbiter.clients.sidecar.perception import (
    Detection,
    DetectorClient,
    RewardClient,
    SceneVlmClient,
)
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    FrameStale,
    MessageTooLarge,
    ModelError,
    SidecarUnavailable,
    UnknownOp,
    VramError,
)
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import RealTimeChunking

pytestmark = pytest.mark.anyio

GROUNDED = "<ref>red cube</ref><box><100><200><300><600></box>"


@pytest.fixture(params=["ipc", "tcp"])
def server(request: pytest.FixtureRequest, short_folder: Path) -> Iterator[FieldServer]:
    where = f"ipc://{short_folder}/s" if request.param == "ipc" else "tcp://127.0.0.1:*"
    with FieldServer(where, GROUNDED) as started:
        yield started


def shade(blue: int, size: tuple[int, int] = (4, 3)) -> bytes:
    pytest.importorskip("PIL")
    return encoded(size=size, color=(7, 8, blue))


async def test_every_operation_of_the_op_family(server: FieldServer) -> None:
    async with DetectorClient(server.endpoint) as detector:
        assert not detector.of_field, "it is not known yet"
        found = await detector.detect(PNG, "red cube", score_threshold=0.4)
        assert found == [Detection("red cube", 1.0, (20.0, 20.0, 60.0, 60.0))]
        assert detector.of_field
        assert (await detector.ping())["state"] == "resident"
        assert (await detector.ping())["rskill"] == "field/model"
        loaded = await detector.load(timeout_s=1.0)
        assert (loaded["lease_id"], loaded["token"], loaded["loaded"]) == (None, None, False)
        with pytest.raises(UnknownOp, match="vramctl run"):
            await detector.unload()
    assert set(server.heard[1]) == {"op", "id", "image", "query", "max_side"}
    async with SceneVlmClient(server.endpoint) as vlm:
        assert await vlm.query(PNG, "held?", fresh_s=60.0) == f"held? {len(PNG)}"
    async with RewardClient(server.endpoint) as reward:
        judged = await reward.score([shade(blue) for blue in range(0, 200, 10)], "grab")
        assert len(judged.progress) == len(judged.success) == 8
        assert judged.progress[0] == 0.0, "the oldest"
        assert judged.progress[-1] == 190 / 255, "the newest: blue comes first"
        assert judged.success_threshold == 0.5
        assert (await reward.score([shade(255)], "grab")).progress == (1.0,)
        with pytest.raises(BadRequest, match="several sizes"):
            await reward.score([shade(1), shade(1, (3, 4))], "grab")
        with pytest.raises(BadRequest, match="cannot be decoded"):
            await reward.score([PNG], "grab")
        await reward.shutdown()
    server._thread.join()


async def test_every_operation_of_the_endpoint_family(server: FieldServer) -> None:
    np = pytest.importorskip("numpy")
    async with PolicyClient(server.endpoint) as policy:
        assert (await policy.load())["lease_id"] is None
        assert await policy.reset() == {"options": None}
        assert await policy.reset({"task": "grab"}) == {"options": {"task": "grab"}}
        state = np.arange(2, dtype=np.float32).reshape(1, 1, 2)
        server.action = {
            "action.y": {b"nd": True, b"type": "<f4", b"shape": [2], b"data": bytes(8)},
            "action.z": {b"nd": False, b"type": "<f8", b"data": bytes(8)},
        }
        actions = await policy.get_action({"state.x": state, "task": ("grab",)})
        assert (actions["action.x"] == state + 1).all()
        assert (actions["action.y"] == np.zeros(2, np.float32)).all()
        assert actions["action.z"] == 0.0
        assert server.heard[-1]["data"]["options"] is None
        assert server.heard[-1]["data"]["observation"]["task"] == ["grab"]
        with pytest.raises(ModelError, match="as asked"):
            await policy.get_action({"state.x": state, "task": "fail"})
        server.action = {"bad": {b"nd": True, b"type": "|O", b"kind": b"O", b"data": b"pickle"}}
        with pytest.raises(BadRequest, match="not of numbers"):
            await policy.get_action({"state.x": state})
        await policy.shutdown()
    server._thread.join()


@pytest.mark.parametrize(
    ("query", "error", "told"),
    [
        ("fail", ModelError, "ValueError: as asked"),
        ("garbage", ModelError, "not a msgpack value"),
        ("many", ModelError, "more than 65536 values"),
        ("huge", SidecarUnavailable, "hung up"),
        ("list", ModelError, "answered with list"),
        ("die", SidecarUnavailable, "no answer to detect|hung up"),
    ],
)
async def test_what_goes_wrong_is_typed_and_the_next_call_works(
    server: FieldServer, query: str, error: type[VramError], told: str
) -> None:
    async with DetectorClient(server.endpoint, timeout_s=60.0) as detector:
        with pytest.raises(error, match=told):
            await detector.detect(PNG, query)
        if query == "die":
            server._thread.join()
            with FieldServer(server.endpoint, GROUNDED):
                assert len(await detector.detect(PNG, "x")) == 1
        else:
            assert len(await detector.detect(PNG, "x")) == 1


async def test_a_late_answer_is_not_the_next_ones(server: FieldServer) -> None:
    """Answers are told by their order alone."""
    async with SceneVlmClient(server.endpoint, timeout_s=60.0) as vlm:
        await vlm.ping()
        with pytest.raises(SidecarUnavailable, match="no answer to query"):
            await vlm.query(PNG, "hang", timeout_s=0.1)
        given_up = asyncio.create_task(vlm.query(PNG, "hang again"))
        while not vlm._turn.locked():
            await asyncio.sleep(0)
        given_up.cancel()
        with pytest.raises(asyncio.CancelledError):
            await given_up
        server.release.set()
        assert await vlm.query(PNG, "now?") == f"now? {len(PNG)}"


async def test_requests_take_turns_and_a_picture_that_waited_is_not_looked_at(
    server: FieldServer,
) -> None:
    async with SceneVlmClient(server.endpoint, timeout_s=60.0) as vlm:
        await vlm.ping()
        first = asyncio.create_task(vlm.query(PNG, "hang"))
        while not vlm._turn.locked():
            await asyncio.sleep(0)
        with pytest.raises(FrameStale, match="nothing was looked at"):
            await vlm.query(PNG, "old", fresh_s=0.05)
        with pytest.raises(SidecarUnavailable, match="no answer to ping"):
            await vlm.ping(timeout_s=0.05)
        others = [asyncio.create_task(vlm.query(PNG, text)) for text in "abc"]
        server.release.set()
        assert await first == f"hang {len(PNG)}", "those that gave up before it did not disturb it"
        assert [answer[0] for answer in await asyncio.gather(*others)] == ["a", "b", "c"]
    assert "old" not in [request.get("question") for request in server.heard]


async def test_what_it_would_answer_wrongly_is_refused(short_folder: Path) -> None:
    with FieldServer(f"ipc://{short_folder}/s") as server:
        async with DetectorClient(server.endpoint) as client:
            assert await client.detect(PNG, "nothing there") == []
            with pytest.raises(BadRequest, match="knows no tokens"):
                await client.detect(PNG, "x", token=(1, 2))
            with pytest.raises(BadRequest, match="not a PNG"):
                await client.detect(b"\xff\xd8\xff" + bytes(64), "x")
            with pytest.raises(BadRequest, match="query with images, video"):
                await client.call("query", {"images": [PNG] * 2, "video": [PNG], "question": "?"})
            with pytest.raises(BadRequest, match="needs an image"):
                await client.call("query", {"images": [], "question": "?"})
            one = {"images": [PNG], "video": [], "question": "?"}
            assert (await client.call("query", one))["answer"] == f"? {len(PNG)}"
            with pytest.raises(UnknownOp, match="no dance"):
                await client.call("dance")
            with pytest.raises(MessageTooLarge, match="limit is 67108864"):
                await client.detect(PNG + bytes(2**26), "x")
        assert [request["op"] for request in server.heard] == ["ping", "detect", "query"]
        async with PolicyClient(server.endpoint) as policy:
            with pytest.raises(UnknownOp, match="no get_actions"):
                await policy.call("get_actions")
            rtc = RealTimeChunking(left_over=((0.5,),), inference_delay=1, execution_horizon=1)
            with pytest.raises(BadRequest, match="takes no remaining chunk"):
                await policy.get_action({}, rtc=rtc)


async def test_a_server_may_be_replaced_by_one_of_the_other_kind(short_folder: Path) -> None:
    endpoint = f"ipc://{short_folder}/s"

    async def ours(client: SceneVlmClient) -> str:
        server = RouterServer(endpoint, lambda error: {"ok": False})

        async def handle(peer: Peer, message: Message) -> None:
            reply = {"ok": True, "answer": f"{message.get('token')}", "re": message["id"]}
            await server.send(peer, reply)

        async with answering(server, handle):
            return await client.query(PNG, "?", token=(1, 2))

    async with SceneVlmClient(endpoint) as client:
        assert await ours(client) == "[1, 2]"
        await noticed(client)
        with FieldServer(endpoint):
            assert await client.query(PNG, "?") == f"? {len(PNG)}"
            assert client.of_field
            with pytest.raises(BadRequest, match="no tokens"):
                await client.query(PNG, "?", token=(1, 2))
        await noticed(client)
        assert await ours(client) == "[1, 2]"


async def noticed(client: SceneVlmClient) -> None:
    """Wait until the client knows that its connection has ended."""
    while client._rpc.proven:
        await asyncio.sleep(0)


@pytest.mark.parametrize("endpoint", ["tcp://10.0.0.1:5757", "tcp://127.0.0.1", "tcp://[::1]:5757"])
async def test_only_ports_of_this_machine_are_connected_to(endpoint: str) -> None:
    async with DetectorClient(endpoint, connect_timeout_s=60.0) as client:
        with pytest.raises(ConfigError, match=r"tcp://127\.0\.0\.1:PORT"):
            await client.detect(PNG, "x")


@pytest.mark.parametrize(
    ("answer", "boxes"),
    [
        ("", []),
        ("None.", []),
        ("<box><0><0><500><500></box>", [("query", 0, 0, 100, 50)]),
        (
            "<ref> a </ref><box><0><0><500><500></box><box><500><500><600><600></box>"
            "<ref></ref><box><500><500><600><600></box>",
            [("a", 0, 0, 100, 50), ("a", 100, 50, 120, 60), ("query", 100, 50, 120, 60)],
        ),
        ("<ref>a</ref>" + "<box><600><600><500><500></box>" * 9, [("a", 100, 50, 120, 60)]),
        ("<box><500><500><2000><999999></box>", [("query", 100, 50, 200, 100)]),
        ("<box><981><0><1000><1000></box><box><0><0><990><990></box><box><1><2></box>", []),
        ("<ref>" * 9000, []),
    ],
)
def test_grounding_texts(answer: str, boxes: list[tuple[str, int, int, int, int]]) -> None:
    found = grounded(answer, 1000, (200, 100), "query")
    assert [(one["label"], *map(round, one["box"])) for one in found] == boxes


@pytest.mark.parametrize(
    ("answer", "norm"), [(None, 1000), (7, 1000), ("x" * 65_537, 1000), ("", 0), ("", "1000")]
)
def test_what_is_no_grounding_text_is_an_error_and_not_an_empty_picture(
    answer: object, norm: object
) -> None:
    with pytest.raises(ModelError):
        grounded(answer, norm, (200, 100), "query")
