"""`vram-gateway demo`: two stand-in model servers, of which one fits at a time, and simulated users
of both, on a simulated GPU with an arbiter of its own (`clients.cli.demo_quick`).
"""

import asyncio
import importlib.util
import os
import random
import sys
import time
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import aiohttp
import yaml

from vram_arbiter.clients.cli.demo_quick import draw, follow
from vram_arbiter.clients.cli.programs import Programs, private_arbiter
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE

SERVERS: Final = {"chat": "5.3GB", "code": "4.3GB"}
USERS: Final = 4
"""Of each server."""
USE_S: Final = 9.0
"""With start and end it stays below half a minute on two busy cores."""
PAUSE_S: Final = 1.0
"""Mean pause of a user between requests."""
PATIENCE_S: Final = 60.0
PAGE: Final = ("--http", "127.0.0.1:0")


@dataclass(frozen=True, slots=True)
class Asked:
    """One request: its server, whether its whole answer came, and the seconds until its first
    words."""

    model: str
    whole: bool
    first_s: float


def run(*, browser: bool) -> int:
    """Return 0 if every request was answered, of both servers."""
    return asyncio.run(_demo(browser=browser))


async def _demo(*, browser: bool) -> int:
    page = PAGE if importlib.util.find_spec("starlette") is not None else ()
    print("starting an arbiter on a simulated GPU of 8 GiB, and the gateway", flush=True)
    async with private_arbiter("demo", "fake:8GiB", *page) as (programs, client):
        config = programs.log_dir / "gateway.yaml"
        config.write_text(yaml.safe_dump(_config()))
        await programs.start("gateway", "sidecars.gateway", "serve", "--config", str(config))
        url = await _told(programs, "gateway", r"^(http://\S+)$")
        print(f"OpenAI's API: {url}/v1, models {' and '.join(SERVERS)}, {USERS} users each")
        if page:
            shown = await _told(programs, "arbiter", r"status page: (http://\S+)")
            print(f"status page: {shown}", flush=True)
            if browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                webbrowser.open(shown)
        users = asyncio.create_task(_use(url))
        events = await follow(client, lambda: not users.done())
        asked = await users
        draw(events, programs.environ[ENDPOINT_VARIABLE])
    print()
    for name in SERVERS:
        mine = [one for one in asked if one.model == name]
        print(
            f"{name}: requests {len(mine)}, failed {sum(not one.whole for one in mine)}, "
            f"switches {sum(_took_over(event, name) for event in events)}, "
            f"longest wait {max((one.first_s for one in mine), default=0.0):.1f} s"
        )
    answered = {one.model for one in asked if one.whole}
    return 0 if answered == {*SERVERS} and all(one.whole for one in asked) else 1


def _took_over(event: JsonMap, name: str) -> bool:
    return event["kind"] == "switch" and bool(event["switched"]) and event["consumer"] == name


def _config() -> dict[str, object]:
    stand_in = [sys.executable, "-m", "vram_arbiter.sidecars.gateway.stand_in"]
    servers = {
        name: {"command": [*stand_in, name, size, "{port}"], "vram": size}
        for name, size in SERVERS.items()
    }
    return {"listen": "127.0.0.1:0", "servers": servers}


async def _told(programs: Programs, name: str, pattern: str) -> str:
    """Wait for a program to say something. Raises SidecarUnavailable if one ends instead."""
    while (said := programs.running[name].said(pattern)) is None:
        programs.check()
        await asyncio.sleep(0.1)
    return said


async def _use(url: str) -> Sequence[Asked]:
    """Ask as all users do, for USE_S."""
    asked: list[Asked] = []
    until_s = time.monotonic() + USE_S
    timeout = aiohttp.ClientTimeout(PATIENCE_S)
    async with aiohttp.ClientSession(timeout=timeout) as session:

        async def chat(model: str) -> None:
            while time.monotonic() < until_s:
                await asyncio.sleep(random.expovariate(1 / PAUSE_S))
                asked.append(await _ask(session, url, model))

        await asyncio.gather(*(chat(model) for model in SERVERS for _ in range(USERS)))
    return asked


async def _ask(session: aiohttp.ClientSession, url: str, model: str) -> Asked:
    began_s = first_s = time.monotonic()
    messages = [{"role": "user", "content": "where is the cup?"}]
    body = {"model": model, "stream": True, "messages": messages}
    answer = b""
    try:
        async with session.post(f"{url}/v1/chat/completions", json=body) as reply:
            async for chunk in reply.content.iter_any():
                first_s = first_s if answer else time.monotonic()
                answer += chunk
    except (aiohttp.ClientError, TimeoutError):
        return Asked(model, False, time.monotonic() - began_s)
    return Asked(model, reply.status == 200 and b"[DONE]" in answer, first_s - began_s)
