"""Requests that free and restore, against a stand-in server on loopback."""

import socket
from collections.abc import Iterator

import pytest

from tests.support.model_server import ModelServer
from vram_arbiter.clients.foreign.actions import Deadline
from vram_arbiter.clients.foreign.http import HttpAction, Request, call, checked_url
from vram_arbiter.clients.foreign.servers import SERVERS, Server
from vram_arbiter.schemas.errors import ActionFailed

LIMIT_S = 30.0
FREEING = {
    "vllm": [("POST /sleep?level=1", None)],
    "ollama": [
        ("GET /api/ps", None),
        ("POST /api/generate", {"model": "a", "keep_alive": 0}),
        ("POST /api/generate", {"model": "b", "keep_alive": 0}),
        ("GET /api/ps", None),
        ("GET /api/ps", None),
    ],
    "llama.cpp": [
        ("GET /models", None),
        ("POST /models/unload", {"model": "a"}),
        ("POST /models/unload", {"model": "b"}),
        ("GET /models", None),
        ("GET /models", None),
    ],
    "comfyui": [("POST /free", {"unload_models": True, "free_memory": True})],
}


@pytest.fixture
def model_server() -> Iterator[ModelServer]:
    with ModelServer() as server:
        yield server


@pytest.mark.parametrize("name", SERVERS)
def test_a_server_is_freed_by_its_own_api(name: str, model_server: ModelServer) -> None:
    """Where the API lists models, freeing is over when it lists none: Ollama and llama.cpp answer
    before a model is gone."""
    server: Server = SERVERS[name](model_server.url, LIMIT_S)
    model_server.lingering = 1
    server.free([])
    assert model_server.heard == FREEING[name]
    assert model_server.loaded == []
    model_server.heard.clear()
    server.restore([])
    assert model_server.heard == ([("POST /wake_up", None)] if name == "vllm" else [])


def test_requests_in_progress_are_counted_where_the_server_tells(model_server: ModelServer) -> None:
    for name, counts in {"vllm": [3], "llama.cpp": [1, 0], "comfyui": [2]}.items():
        server = SERVERS[name](model_server.url, LIMIT_S)
        model_server.busy = list(counts)
        assert (server.busy(), server.busy()) == (sum(counts), 0)
    assert SERVERS["ollama"](model_server.url, LIMIT_S).busy() is None
    model_server.broken = {"/metrics": 404, "/slots": 501}
    assert SERVERS["vllm"](model_server.url, LIMIT_S).busy() is None
    assert SERVERS["llama.cpp"](model_server.url, LIMIT_S).busy() is None


def test_a_download_of_llama_cpp_is_left_alone(model_server: ModelServer) -> None:
    """Regression: it counted as loaded, and making room canceled the user's download. A model that
    sleeps has a process with a context, which ends."""
    model_server.states = {"c": "unloaded", "d": "downloading", "e": "sleeping", "f": "downloaded"}
    SERVERS["llama.cpp"](model_server.url, LIMIT_S).free([])
    assert model_server.loaded == model_server.lost == []
    assert model_server.states == {**model_server.states, "d": "downloading", "e": "unloaded"}


def test_a_load_of_llama_cpp_is_work(model_server: ModelServer) -> None:
    """Regression: a model that loads counted as idle, and unloading kills its load, with the
    request that it is for. It is work also where the server shows no slots."""
    model_server.states = {"c": "unloaded", "d": "loading"}
    server = SERVERS["llama.cpp"](model_server.url, LIMIT_S)
    assert server.busy() == 1
    model_server.busy = [1, 0]
    assert server.busy() == 2
    model_server.broken = {"/slots": 501}
    assert server.busy() == 1


def test_a_look_at_llama_cpp_loads_nothing(model_server: ModelServer) -> None:
    """Regression: `/slots` of a model that left between two looks loaded it again."""

    def leaves_meanwhile(path: str, body: object) -> object:
        if path == "/slots":
            model_server.loaded = []
        return ModelServer.answer(model_server, path, body)

    model_server.answer = leaves_meanwhile  # type: ignore[method-assign]
    assert SERVERS["llama.cpp"](model_server.url, LIMIT_S).busy() == 0
    assert model_server.loaded == []


def test_a_model_of_llama_cpp_that_ends_meanwhile_keeps_no_other(model_server: ModelServer) -> None:
    """Regression: the router answers 400 for a model that is not running any more, and the models
    behind it kept their memory."""

    def ends_meanwhile(path: str, body: object) -> object:
        if path == "/models/unload" and "a" in model_server.loaded:
            model_server.unload("a")
        return ModelServer.answer(model_server, path, body)

    model_server.answer = ends_meanwhile  # type: ignore[method-assign]
    SERVERS["llama.cpp"](model_server.url, LIMIT_S).free([])
    assert model_server.loaded == []
    model_server.loaded, model_server.broken = ["a"], {"/models/unload": 500}
    with pytest.raises(ActionFailed, match="answered 500"):
        SERVERS["llama.cpp"](model_server.url, LIMIT_S).free([])


def test_what_a_failing_server_says_is_told(model_server: ModelServer) -> None:
    vllm = SERVERS["vllm"](model_server.url, LIMIT_S)
    model_server.broken = {"/sleep": 500}
    with pytest.raises(ActionFailed, match=r"/sleep\?level=1: answered 500: broken") as raised:
        vllm.free([])
    assert "\x1b" not in str(raised.value)
    model_server.broken = {}
    model_server.lingering = 10**6
    with pytest.raises(ActionFailed, match=r"still loaded: a, b: not done within 0\.3 s"):
        SERVERS["ollama"](model_server.url, 0.3).free([])
    with pytest.raises(ActionFailed, match="expected a list of models"):
        SERVERS["ollama"](f"{model_server.url}/other", LIMIT_S).free([])


def test_a_llama_server_that_is_no_router_is_refused(model_server: ModelServer) -> None:
    """With one model given, `/models` has no status, and nothing can be unloaded."""
    model_server.answer = lambda path, body: {"data": [{"id": "a"}]}  # type: ignore[method-assign]
    with pytest.raises(ActionFailed, match="start llama-server without a model"):
        SERVERS["llama.cpp"](model_server.url, LIMIT_S).free([])


def test_a_server_that_is_down_silent_or_speaks_no_http() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(ActionFailed, match=r"no answer within 0\.2 s"):
            SERVERS["vllm"](url, 0.2).free([])
    vllm = SERVERS["vllm"](url, LIMIT_S)
    assert vllm.busy() is None
    with pytest.raises(ActionFailed, match="refused"):
        vllm.free([])


def test_any_request_may_free_and_restore(model_server: ModelServer) -> None:
    freeing = Request(f"{model_server.url}/free?x=1", "PUT", '{"a": 1}')
    action = HttpAction(freeing, Request(f"{model_server.url}/restore", "PUT"), LIMIT_S)
    action.free([])
    action.restore([])
    assert model_server.heard == [("PUT /free?x=1", {"a": 1}), ("PUT /restore", None)]
    HttpAction(freeing, None, LIMIT_S).restore([])  # nothing to call
    assert len(model_server.heard) == 2


def test_a_redirect_is_not_followed(model_server: ModelServer) -> None:
    """It could lead off this machine."""
    model_server.broken = {"/free": 307}
    with pytest.raises(ActionFailed, match="answered 307"):
        call(Request(f"{model_server.url}/free"), Deadline(LIMIT_S))


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("127.0.0.1:8000", "such as http"),
        ("ftp://localhost/free", "such as http"),
        ("http://user:secret@localhost/", "without user"),
        ("http://localhost:0/", "such as http"),
        ("http://localhost:x/", "such as http"),
        ("http://localhost/a b", "spaces"),
        ("http://192.0.2.1:8000/", "not a loopback host"),
        ("http://localhost.example.org/", "not a loopback host"),
    ],
)
def test_urls_that_are_refused(url: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        checked_url(url, remote=False)


def test_urls_that_are_called() -> None:
    for url in ("http://localhost:8000", "http://127.0.0.2/x", "https://[::1]:8/?a=1"):
        assert checked_url(url + "/" if url.endswith("00") else url, remote=False) == url
    assert checked_url("http://192.0.2.1:8000/", remote=True) == "http://192.0.2.1:8000"
