"""One JSON request to a model server that may be slow, broken or hostile.

Bounded in time, bytes and tries. The limit is on the whole exchange: a server that sends a byte a
second is as late as a silent one. A busy or failing server (`RETRY_STATUSES`) and a broken
connection are tried again after a pause; a wrong key or a wrong request is not.
"""

import asyncio
import importlib.util
import json
import logging
from collections.abc import Mapping
from typing import Any, Self
from urllib.parse import urlsplit, urlunsplit

from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.errors import ConfigError, LlmError
from vram_arbiter.schemas.plain import JsonObject

log = logging.getLogger(__name__)

TRIES_MAX = 3
RETRY_PAUSE_S = 0.5  # doubled each time
RETRY_STATUSES = frozenset({408, 429, 500, 502, 503, 504, 529})
ANSWER_MAX_BYTES = 1 << 20
COMPLAINT_MAX_CHARS = 300


class _Busy(Exception):
    """Worth another try."""


def check_installed() -> None:
    """Raise ConfigError without the reasoner's extra."""
    if importlib.util.find_spec("httpx") is None:
        raise ConfigError("httpx is not installed", hint="pip install 'vram-arbiter[reasoner]'")


class JsonHttp:
    """`async with JsonHttp(headers, timeout_s) as http: await http.post(url, body)`.

    Redirects are not followed: the key must not reach another server.
    """

    def __init__(
        self, headers: Mapping[str, str], timeout_s: float, *, retry_pause_s: float = RETRY_PAUSE_S
    ) -> None:
        self._headers = dict(headers)
        self._timeout_s = timeout_s
        self._retry_pause_s = retry_pause_s
        self._http: Any = None
        # its line for each request has the whole address in it, with a password or a key; our
        # errors carry the rest
        logging.getLogger("httpx").setLevel(logging.WARNING)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        if self._http is not None:
            await self._http.aclose()

    async def post(self, url: str, body: JsonObject) -> JsonObject:
        """Return the answer's JSON object. Raises LlmError for every failure."""
        shown = without_credentials(url)
        content = json.dumps(body, ensure_ascii=False).encode(errors="replace")
        problem = ""
        for number in range(TRIES_MAX):
            if number:
                log.warning("%s: %s; trying again", shown, problem)
                await asyncio.sleep(self._retry_pause_s * 2 ** (number - 1))
            try:
                async with asyncio.timeout(self._timeout_s):
                    return await self._once(url, content)
            except TimeoutError as error:
                raise LlmError(
                    f"no answer from {shown} within {self._timeout_s:g} s",
                    hint="raise VRAM_REASONER_LLM_TIMEOUT_S",
                ) from error
            except _Busy as error:
                problem = str(error)
        raise LlmError(
            f"{shown}: {problem}, {TRIES_MAX} times",
            hint="is the server running, and does it keep up?",
        )

    async def _once(self, url: str, content: bytes) -> JsonObject:
        import httpx  # only installed with the reasoner's extra

        shown = without_credentials(url)
        if self._http is None:
            self._http = httpx.AsyncClient(
                headers=self._headers, timeout=self._timeout_s, follow_redirects=False
            )
        try:
            async with self._http.stream(
                "POST", url, content=content, headers={"content-type": "application/json"}
            ) as response:
                answer = await self._read(shown, response)
                status = int(response.status_code)
        except httpx.TimeoutException as error:
            raise TimeoutError from error
        except httpx.TransportError as error:
            raise _Busy(f"{type(error).__name__}: {error}") from error
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise LlmError(
                f"{shown}: {error}", hint="is VRAM_REASONER_LLM_BASE_URL right?"
            ) from error
        if status in RETRY_STATUSES:
            raise _Busy(f"HTTP status {status}: {_complaint(answer)}")
        if status != 200:
            raise LlmError(
                f"{shown}: HTTP status {status}: {_complaint(answer)}",
                hint="are address, key and model right?",
            )
        try:
            value = strictjson.loads(answer, max_chars=ANSWER_MAX_BYTES)
        except ValueError as error:
            raise LlmError(f"{shown} did not answer with JSON: {error}") from error
        if not isinstance(value, dict):
            raise LlmError(f"{shown} answered a JSON {type(value).__name__}, not an object")
        return value

    @staticmethod
    async def _read(url: str, response: Any) -> bytes:
        parts: list[bytes] = []
        size = 0
        async for part in response.aiter_bytes():
            size += len(part)
            if size > ANSWER_MAX_BYTES:
                raise LlmError(f"{url} answered more than {ANSWER_MAX_BYTES} bytes")
            parts.append(part)
        return b"".join(parts)


def without_credentials(url: str) -> str:
    """Return the address for a log or a result: without user, password and query."""
    parts = urlsplit(url)
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def _complaint(answer: bytes) -> str:
    """Return the server's own error text on one line. Both APIs put it under `error.message`."""
    text = answer.decode(errors="replace")
    try:
        error = json.loads(text)["error"]
        text = str(error["message"] if isinstance(error, dict) else error)
    except (ValueError, LookupError, TypeError, RecursionError):
        pass
    return " ".join(text.split())[:COMPLAINT_MAX_CHARS] or "no words"
