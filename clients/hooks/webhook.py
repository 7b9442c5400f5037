"""One event by POST, repeated where that helps.

Requests go through `clients.foreign.http`, each in a thread of its own: a request a second needs no
HTTP package in the base install, and redirects and proxies of the environment are not followed, so
a token reaches the named host and no other.
"""

import asyncio
import email.utils
import os
import random
import stat
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Final

from vram_arbiter.clients.foreign.actions import Deadline
from vram_arbiter.clients.foreign.http import Reply, Request, answer
from vram_arbiter.clients.hooks.events import Delivery
from vram_arbiter.schemas.config.hooks import Hook
from vram_arbiter.schemas.errors import ActionFailed, ConfigError
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version

PAUSE_S: Final = 1.0
"""Before the second request; doubled for each further one."""
PAUSE_MAX_S: Final = 60.0
RETRY_AFTER_MAX_S: Final = 600.0
HEADERS_MAX_BYTES: Final = 16 << 10
SHOWN_MAX_CHARS: Final = 200
AGAIN: Final = frozenset(
    (
        HTTPStatus.REQUEST_TIMEOUT,
        HTTPStatus.TOO_EARLY,
        HTTPStatus.TOO_MANY_REQUESTS,
    )
)
"""Answers below 500 after which the same request may succeed."""

type Post = Callable[[Request, float], Awaitable[Reply]]
type Sleep = Callable[[float], Awaitable[object]]


async def deliver(
    hook: Hook,
    delivery: Delivery,
    said: Callable[[str], None],
    *,
    post: Post | None = None,
    sleep: Sleep = asyncio.sleep,
) -> None:
    """Send one event until it is taken. `said` is told of each request that is repeated.

    Raises ActionFailed.
    """
    assert hook.webhook is not None, f"{hook.name} has no webhook"
    body = delivery.body.decode()
    problem = ""
    for attempt in range(1, hook.attempts + 1):
        wait_s: float | None = None
        try:
            request = Request(hook.webhook, body=body, headers=_headers(hook, delivery))
            reply = await (post or post_in_thread)(request, hook.timeout_s)
            if 200 <= reply.status < 300:
                return
            told = printable(reply.body.decode(errors="replace"))[:SHOWN_MAX_CHARS]
            problem = f"answered {reply.status}" + (f": {told}" if told else "")
            if reply.status < 500 and reply.status not in AGAIN:
                raise ActionFailed(f"{_host(hook)} {problem}", details={"status": reply.status})
            wait_s = retry_after_s(reply.headers, time.time())
        except ConfigError as error:
            problem = error.message
        except ActionFailed as error:
            if "status" in error.details:
                raise
            problem = error.message.replace(str(request), _host(hook))
        if attempt < hook.attempts:
            pause_s = min(PAUSE_MAX_S, PAUSE_S * 2 ** (attempt - 1)) * random.uniform(0.5, 1.0)
            wait_s = pause_s if wait_s is None else max(pause_s, wait_s)
            said(f"{problem}; request {attempt + 1} of {hook.attempts} in {wait_s:.1f} s")
            await sleep(wait_s)
    raise ActionFailed(f"{_host(hook)} took none of {hook.attempts} requests: {problem}")


def retry_after_s(headers: Mapping[str, str], now_wall_s: float) -> float | None:
    """Return the pause that an answer asks for, in seconds or as a date (RFC 9110, 10.2.3)."""
    text = headers.get("retry-after", "").strip()
    if text.isdecimal():
        return min(float(text), RETRY_AFTER_MAX_S)
    try:
        at = email.utils.parsedate_to_datetime(text).timestamp()
    except (ValueError, TypeError):
        return None
    return min(max(0.0, at - now_wall_s), RETRY_AFTER_MAX_S)


def read_headers(path: str) -> Mapping[str, str]:
    """Return the headers of a file, `Name: value` a line. Raises ConfigError."""
    try:
        with Path(path).open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(HEADERS_MAX_BYTES + 1).decode("ascii")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", hint="name a readable file") from error
    except ValueError as error:
        raise ConfigError(f"{path}: expected ASCII text", hint="encode the value") from error
    if stat.S_ISREG(mode) and mode & stat.S_IROTH:
        raise ConfigError(f"{path} may be read by every user", hint=f"chmod o-r {path}")
    if len(text) > HEADERS_MAX_BYTES:
        raise ConfigError(f"{path} has more than {HEADERS_MAX_BYTES} bytes", hint="shorten it")
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        name, colon, value = line.partition(":")
        token = name.replace("-", "").replace("_", "")
        if not colon or not token.isalnum() or not value.strip().isprintable():
            raise ConfigError(f"{path}:{number}: expected `Name: value`", hint="one header a line")
        found[name] = value.strip()
    return found


async def post_in_thread(request: Request, timeout_s: float) -> Reply:
    """Send a request in a thread that a stop of the program does not wait for."""
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[Reply] = loop.create_future()

    def settle(reply: Reply | BaseException) -> None:
        if ended.done():
            return
        if isinstance(reply, BaseException):
            ended.set_exception(reply)
        else:
            ended.set_result(reply)

    def work() -> None:
        result: Reply | BaseException
        try:
            result = answer(request, Deadline(timeout_s))
        except BaseException as error:  # noqa: BLE001 - it is the caller's
            result = error
        try:
            loop.call_soon_threadsafe(settle, result)
        except RuntimeError:
            return  # the loop has ended meanwhile

    threading.Thread(target=work, name="webhook", daemon=True).start()
    try:
        async with asyncio.timeout(2 * timeout_s):  # a name server that hangs
            return await ended
    except TimeoutError as error:
        raise ActionFailed(f"{request}: no answer within {2 * timeout_s:g} s") from error


def _headers(hook: Hook, delivery: Delivery) -> Mapping[str, str]:
    own = {
        "User-Agent": f"vram-arbiter/{version()}",
        "Idempotency-Key": delivery.key,
        "X-Vram-Arbiter-Event": delivery.on,
        "X-Vram-Arbiter-Dropped": str(delivery.dropped),
    }
    return {**own, **(read_headers(hook.headers_file) if hook.headers_file else {})}


def _host(hook: Hook) -> str:
    """Return the server of a webhook, for logs: path and query may be secret."""
    scheme, _, rest = str(hook.webhook).partition("://")
    return f"{scheme}://{rest.partition('/')[0]}"
