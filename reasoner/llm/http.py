"""One JSON request to a model server that may be slow, busy, broken or hostile.

Bounded in time, bytes and tries. The limit is on the whole exchange: a server that sends a byte a
second is as late as a silent one. A busy server (`BUSY_STATUSES`) is asked again until `busy_s`
have passed, after the pause that its `Retry-After` names; a failing one and a broken connection
`TRIES_MAX` times; a wrong key or a wrong request is not repeated.

Not by the vendors' SDKs: they import 7 and 15 times as slowly, bring an HTTP stack of their own,
and would replace the pauses here but none of the limits.
"""

import asyncio
import importlib
import json
import logging
import math
import random
from collections.abc import Awaitable, Callable, Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from time import monotonic
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.errors import LlmError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.extras import need

log = logging.getLogger(__name__)

TRIES_MAX = 3  # of a server that fails, or a connection that breaks
PAUSE_S, PAUSE_MAX_S = 0.5, 30.0  # doubled each time, where the server names none
BUSY_STATUSES = frozenset({429, 503, 529})
FAILING_STATUSES = frozenset({408, 500, 502, 504})
ANSWER_MAX_BYTES = 1 << 20
COMPLAINT_MAX_CHARS = 300


Pause = Callable[[float], Awaitable[None]]


class _TryAgain(Exception):
    """Worth another try, `after_s` from now if the server says so."""

    def __init__(self, problem: str, *, busy: bool = False, after_s: float | None = None) -> None:
        super().__init__(problem)
        self.busy = busy
        self.after_s = after_s


def import_httpx() -> None:
    """Import httpx, which takes longer than many a request, before a time limit counts.

    Raises ConfigError without the reasoner's extra.
    """
    need("a language model", "httpx", extra="reasoner")
    importlib.import_module("httpx")


class JsonHttp:
    """`await JsonHttp(…).post(url, body)`; `close` closes its connections.

    Redirects are not followed: the key must not reach another server. `again` is called before each
    further try of a request.
    """

    def __init__(
        self, headers: Mapping[str, str], config: LlmConfig, pause: Pause, again: Callable[[], None]
    ) -> None:
        import httpx  # only installed with the reasoner's extra

        self._timeout_s, self._busy_s = config.timeout_s, config.busy_s
        self._pause, self._again = pause, again
        self._http = httpx.AsyncClient(
            headers=dict(headers),
            timeout=config.timeout_s,
            follow_redirects=False,
            # reading the machine's certificates takes 40 ms of a core
            verify=urlsplit(config.base_url).scheme != "http",
        )
        # its line for each request has the whole address in it, with a password or a key; our
        # errors carry the rest
        logging.getLogger("httpx").setLevel(logging.WARNING)

    async def close(self) -> None:
        await self._http.aclose()

    async def post(self, url: str, body: JsonObject) -> JsonObject:
        """Return the answer's JSON object. Raises LlmError for every failure."""
        shown = without_credentials(url)
        content = json.dumps(body, ensure_ascii=False).encode(errors="replace")
        left_s, failures, asked = self._busy_s, 0, 0
        while True:
            began_s = monotonic()
            try:
                async with asyncio.timeout(self._timeout_s):
                    return await self._once(url, content)
            except TimeoutError as error:
                raise LlmError(
                    f"no answer from {shown} within {self._timeout_s:g} s",
                    hint="raise VRAM_REASONER_LLM_TIMEOUT_S",
                ) from error
            except _TryAgain as error:
                refused = error
            failures += not refused.busy
            if failures >= TRIES_MAX:
                raise LlmError(
                    f"{shown}: {refused}, {TRIES_MAX} times",
                    hint="is the server running, and fast enough?",
                )
            pause_s = _pause_s(asked) if refused.after_s is None else refused.after_s
            left_s -= monotonic() - began_s + pause_s
            if left_s < 0:
                raise LlmError(
                    f"{shown}: {refused}; the next try is due in {pause_s:g} s, and"
                    f" {self._busy_s:g} s are allowed in all",
                    hint="raise VRAM_REASONER_LLM_BUSY_S, or ask a server with more room",
                )
            asked += 1
            log.warning("%s: %s; asking again in %.1f s", shown, refused, pause_s)
            await self._pause(pause_s)
            self._again()

    async def _once(self, url: str, content: bytes) -> JsonObject:
        import httpx

        shown = without_credentials(url)
        try:
            async with self._http.stream(
                "POST", url, content=content, headers={"content-type": "application/json"}
            ) as response:
                answer = await _read(shown, response)
                status, headers = int(response.status_code), dict(response.headers)
        except httpx.TimeoutException as error:
            raise TimeoutError from error
        except httpx.TransportError as error:
            raise _TryAgain(f"{type(error).__name__}: {error}") from error
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise LlmError(
                f"{shown}: {error}", hint="is VRAM_REASONER_LLM_BASE_URL right?"
            ) from error
        # `x-should-retry: false` stands at an empty account, which is a 429 too
        if status in BUSY_STATUSES | FAILING_STATUSES and headers.get("x-should-retry") != "false":
            after_s = retry_after_s(headers)
            busy = status in BUSY_STATUSES or after_s is not None
            problem = f"HTTP status {status}: {_complaint(answer)}"
            raise _TryAgain(problem, busy=busy, after_s=after_s)
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


async def _read(url: str, response: Any) -> bytes:
    answer = bytearray()
    async for part in response.aiter_bytes():
        answer += part
        if len(answer) > ANSWER_MAX_BYTES:
            raise LlmError(f"{url} answered more than {ANSWER_MAX_BYTES} bytes")
    return bytes(answer)


def _pause_s(asked: int) -> float:
    """Return the pause before the next try, shortened at random: clients that were refused together
    do not come back together.
    """
    return min(PAUSE_S * 2.0 ** min(asked, 16), PAUSE_MAX_S) * random.uniform(0.75, 1.0)


def retry_after_s(headers: Mapping[str, str]) -> float | None:
    """Return the seconds that `retry-after-ms` or `retry-after` (seconds, or a date) names.

    None where neither can be read. Names of headers are lower case.
    """
    for name, unit_s in (("retry-after-ms", 1e-3), ("retry-after", 1.0)):
        text = headers.get(name, "")
        try:
            seconds = float(text) * unit_s
        except ValueError:
            seconds = _until_s(text)
        if math.isfinite(seconds):
            return max(0.0, seconds)
    return None


def _until_s(date: str) -> float:
    try:
        then = parsedate_to_datetime(date)
    except ValueError:
        return math.nan
    # a date without a zone is in UTC
    then = then if then.tzinfo is not None else then.replace(tzinfo=UTC)
    return (then - datetime.now(UTC)).total_seconds()


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
