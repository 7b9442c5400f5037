"""Model servers whose API is known: which requests free their memory, and how they say that they
work."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final
from urllib.parse import quote

from vram_arbiter.clients.foreign.actions import Deadline
from vram_arbiter.clients.foreign.http import OTHER_API, Request, answer, call, call_json
from vram_arbiter.schemas.errors import ActionFailed
from vram_arbiter.schemas.plain import JsonMap

LOOK_TIMEOUT_S: Final = 5.0
"""How long a server may take to say whether it works."""


@dataclass(frozen=True, slots=True)
class Server(ABC):
    """A model server at `url`. A subclass says how it frees.

    Most load again with the next request, so there is nothing to restore.
    """

    url: str
    timeout_s: float
    name: ClassVar[str]
    default_url: ClassVar[str]
    parks: ClassVar[bool] = False
    keeps_context: ClassVar[bool] = True
    suspends: ClassVar[bool] = False

    def check(self) -> None:  # noqa: B027  most have nothing to check
        """It needs nothing of this machine."""

    def busy(self) -> int | None:
        try:
            return self.requests(Deadline(min(LOOK_TIMEOUT_S, self.timeout_s)))
        except ActionFailed:
            return None  # it is down, or does not tell; freeing finds out which

    def requests(self, deadline: Deadline) -> int | None:
        """Return the number of requests in progress. Raises ActionFailed."""
        return None

    @abstractmethod
    def free(self, pids: Sequence[int]) -> None:
        """Free the GPU memory of the server, whose processes are `pids`. Raises ActionFailed."""

    def restore(self, pids: Sequence[int]) -> None:  # noqa: B027  most have nothing to do
        """The next request loads the model."""

    def _get(self, path: str) -> Request:
        return Request(self.url + path, "GET")

    def _post(self, path: str, body: JsonMap | None = None) -> Request:
        return Request(self.url + path, "POST", "" if body is None else json.dumps(body))

    def _until_none(
        self, names: Callable[[Deadline], Sequence[str]], deadline: Deadline, what: str
    ) -> None:
        """Wait until the server lists no loaded model. Raises ActionFailed."""
        while left := names(deadline):
            deadline.pause(f"{what} {', '.join(left)}")


class Vllm(Server):
    """vLLM's sleep mode, level 1: the weights go to host RAM, the KV cache is dropped.

    Needs `vllm serve --enable-sleep-mode` with VLLM_SERVER_DEV_MODE=1
    (https://docs.vllm.ai/en/latest/features/sleep_mode/). `/sleep` aborts requests in progress,
    which `/metrics` counts.
    """

    name = "vllm"
    default_url = "http://127.0.0.1:8000"
    parks = True
    WORK: ClassVar = ("vllm:num_requests_running", "vllm:num_requests_waiting")

    def requests(self, deadline: Deadline) -> int | None:
        text = call(self._get("/metrics"), deadline).decode(errors="replace")
        counts: list[float] = []
        for line in text.splitlines():
            metric, _, value = line.rpartition(" ")
            if metric.partition("{")[0] in self.WORK:
                try:
                    counts.append(float(value))
                except ValueError as error:
                    raise ActionFailed(
                        f"{self.url}/metrics: not a count: {line!r}", hint=OTHER_API
                    ) from error
        return int(sum(counts)) if counts else None

    def free(self, pids: Sequence[int]) -> None:
        call(self._post("/sleep?level=1"), Deadline(self.timeout_s))

    def restore(self, pids: Sequence[int]) -> None:
        call(self._post("/wake_up"), Deadline(self.timeout_s))


class Ollama(Server):
    """Ollama: `keep_alive` 0 for each model that `/api/ps` lists
    (https://github.com/ollama/ollama/blob/main/docs/api.md, "Unload a model").

    A model that answers a request is unloaded after it; so freeing waits until `/api/ps` lists
    none.
    """

    name = "ollama"
    default_url = "http://127.0.0.1:11434"

    def free(self, pids: Sequence[int]) -> None:
        deadline = Deadline(self.timeout_s)
        for model in self._loaded(deadline):
            call(self._post("/api/generate", {"model": model, "keep_alive": 0}), deadline)
        self._until_none(self._loaded, deadline, "POST /api/generate: still loaded:")

    def _loaded(self, deadline: Deadline) -> Sequence[str]:
        request = self._get("/api/ps")
        models = _entries(call_json(request, deadline), "models", request)
        return [str(model.get("model") or model.get("name")) for model in models]


class LlamaCpp(Server):
    """llama.cpp's `llama-server` as a router (started without a model): `/models/unload` for each
    model that has a process (https://github.com/ggml-org/llama.cpp/blob/master/tools/server,
    "Using multiple models"), which ends. One that failed to load is `unloaded`, with a flag.

    Unloading aborts requests in progress, which `/slots` shows unless it is switched off, kills a
    load with the request that it is for, and cancels a download, which holds no GPU memory.
    """

    name = "llama.cpp"
    default_url = "http://127.0.0.1:8080"
    keeps_context = False
    AWAY: ClassVar = ("unloaded", "downloading", "downloaded")
    NOT_RUNNING: ClassVar = 400

    def requests(self, deadline: Deadline) -> int | None:
        models = self._models(deadline)
        busy = sum(status == "loading" for status in models.values())  # each for a request
        for model in [model for model, status in models.items() if status == "loaded"]:
            # without `autoload` it would load a model that left meanwhile
            request = self._get(f"/slots?model={quote(model, safe='')}&autoload=false")
            reply = answer(request, deadline)
            if reply.status == self.NOT_RUNNING:
                continue
            if reply.status != 200:
                return busy or None  # --no-slots
            try:
                slots = json.loads(reply.body)
            except ValueError as error:
                raise ActionFailed(
                    f"{request}: expected JSON, got {reply.body[:40]!r}", hint=OTHER_API
                ) from error
            busy += sum(bool(slot.get("is_processing")) for slot in slots)
        return busy

    def free(self, pids: Sequence[int]) -> None:
        deadline = Deadline(self.timeout_s)
        for model in self._loaded(deadline):
            unload = self._post("/models/unload", {"model": model})
            call(unload, deadline, besides=self.NOT_RUNNING)  # it ended meanwhile
        self._until_none(self._loaded, deadline, "POST /models/unload: still loaded:")

    def _loaded(self, deadline: Deadline) -> Sequence[str]:
        models = self._models(deadline)
        return [model for model, status in models.items() if status not in self.AWAY]

    def _models(self, deadline: Deadline) -> Mapping[str, str]:
        """Return the state of each model. Raises ActionFailed."""
        request = self._get("/models")
        models = _entries(call_json(request, deadline), "data", request)
        if not all(isinstance(model.get("status"), dict) for model in models):
            raise ActionFailed(
                f"{request}: models without a status",
                hint="start llama-server without a model: only its router can unload",
            )
        return {str(model.get("id")): str(model["status"].get("value")) for model in models}


class ComfyUi(Server):
    """ComfyUI: `POST /free` (routes of https://github.com/comfyanonymous/ComfyUI, `server.py`).

    It answers before it frees: its worker does so when no prompt runs. `/queue` lists prompts.
    """

    name = "comfyui"
    default_url = "http://127.0.0.1:8188"

    def requests(self, deadline: Deadline) -> int | None:
        request = self._get("/queue")
        queue = call_json(request, deadline)
        if not isinstance(queue, dict):
            raise ActionFailed(f"{request}: expected a map", hint=OTHER_API)
        return sum(len(queue.get(name) or ()) for name in ("queue_running", "queue_pending"))

    def free(self, pids: Sequence[int]) -> None:
        wanted = {"unload_models": True, "free_memory": True}
        call(self._post("/free", wanted), Deadline(self.timeout_s))


SERVERS: Final[Mapping[str, type[Server]]] = {
    server.name: server for server in (Vllm, Ollama, LlamaCpp, ComfyUi)
}


def _entries(found: object, key: str, request: Request) -> Sequence[JsonMap]:
    """Return the list of maps at `key`. Raises ActionFailed."""
    entries = found.get(key) if isinstance(found, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ActionFailed(f"{request}: expected a list of {key}", hint=OTHER_API)
    return entries
