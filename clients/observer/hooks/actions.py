"""What a rule starts: a command (`command`), or a POST that is repeated where that helps.

Redirects and proxies of the environment are not followed, so a token reaches the named host and no
other. Of an answer the beginning is read, and the time limit is that of the whole exchange.
"""

import asyncio
import logging
import os
import random
import stat
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import httpx

from vram_arbiter.clients.observer.hooks.command import run_command
from vram_arbiter.clients.observer.hooks.events import Delivery, environ_of
from vram_arbiter.schemas.config.observer import Hook
from vram_arbiter.schemas.errors import ActionFailed, ConfigError
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version

log = logging.getLogger(__name__)

PAUSE_S: Final = 1.0
"""Before the second request; doubled for each further one."""
PAUSE_MAX_S: Final = 60.0
RETRY_AFTER_MAX_S: Final = 600.0
HEADERS_MAX_BYTES: Final = 16 << 10
SHOWN_MAX_CHARS: Final = 200
AGAIN: Final = (408, 425, 429)
"""Answers below 500 after which the same request may succeed: late, early, too many."""

type Sleep = Callable[[float], Awaitable[object]]


async def act(hook: Hook, delivery: Delivery, endpoint: str) -> None:
    """Perform one delivery. Raises ActionFailed."""
    if hook.command is not None:
        environ = environ_of(delivery, endpoint)
        await run_command(hook.command, delivery.body + b"\n", environ, hook.timeout_s)
    else:
        await post(hook, delivery)


# -- webhooks
async def post(hook: Hook, delivery: Delivery, sleep: Sleep = asyncio.sleep) -> None:
    """Send one event until it is taken. Raises ActionFailed."""
    host, problem = _host(hook), ""
    async with httpx.AsyncClient(trust_env=False, timeout=hook.timeout_s) as client:
        for attempt in range(1, hook.attempts + 1):
            wait_s = 0.0
            try:
                headers = _headers(hook, delivery)
                async with (
                    asyncio.timeout(hook.timeout_s),
                    client.stream(
                        "POST", str(hook.webhook), content=delivery.body, headers=headers
                    ) as reply,
                ):
                    if reply.is_success:
                        return
                    began = await anext(reply.aiter_raw(SHOWN_MAX_CHARS), b"")
                said = printable(began.decode(errors="replace"))
                problem = f"answered {reply.status_code}: {said}"
                if reply.status_code < 500 and reply.status_code not in AGAIN:
                    raise ActionFailed(f"{host} {problem}")
                wait_s = retry_after_s(reply.headers.get("retry-after", ""))
            except (httpx.HTTPError, httpx.InvalidURL, TimeoutError, ConfigError) as error:
                problem = str(error) or type(error).__name__
            if attempt < hook.attempts:
                pause_s = min(PAUSE_MAX_S, PAUSE_S * 2 ** (attempt - 1)) * random.uniform(0.5, 1.0)
                log.warning("%s: %s; request %d follows", hook.name, problem, attempt + 1)
                await sleep(max(pause_s, wait_s))
    raise ActionFailed(f"{host} took none of {hook.attempts} requests: {problem}")


def retry_after_s(text: str) -> float:
    """Return the pause that an answer asks for in seconds; 0: none."""
    return min(float(text), RETRY_AFTER_MAX_S) if text.strip().isdecimal() else 0.0


def read_headers(path: str) -> Mapping[str, str]:
    """Return the headers of a file, `Name: value` a line. Raises ConfigError."""
    try:
        with Path(path).open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(HEADERS_MAX_BYTES + 1).decode("ascii")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}", hint="name a readable ASCII file") from error
    if stat.S_ISREG(mode) and mode & stat.S_IROTH:
        raise ConfigError(f"{path} may be read by every user", hint=f"chmod o-r {path}")
    if len(text) > HEADERS_MAX_BYTES:
        raise ConfigError(f"{path} has more than {HEADERS_MAX_BYTES} bytes")
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        name, colon, value = line.partition(":")
        if line.strip() and not line.startswith("#"):
            plain = name.replace("-", "").replace("_", "").isalnum() and value.strip().isprintable()
            if not colon or not plain:
                raise ConfigError(f"{path}:{number}: expected `Name: value`")
            found[name] = value.strip()
    return found


def _headers(hook: Hook, delivery: Delivery) -> Mapping[str, str]:
    own = {
        "Accept-Encoding": "identity",  # an answer is shown as it comes
        "Content-Type": "application/json",
        "User-Agent": f"vram-arbiter/{version()}",
        "Idempotency-Key": delivery.key,
        "X-Vram-Arbiter-Event": delivery.on,
        "X-Vram-Arbiter-Dropped": str(delivery.dropped),
    }
    return {**own, **(read_headers(hook.headers_file) if hook.headers_file else {})}


def _host(hook: Hook) -> str:
    """Return the server of a webhook, for logs: path and query may be secret."""
    parts = urlsplit(str(hook.webhook))
    return f"{parts.scheme}://{parts.netloc}"
