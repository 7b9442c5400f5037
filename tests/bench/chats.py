"""Clients of a chat completion API: each asks, reads its whole stream, pauses, and asks again.

What a client sees is all that is measured here, so that every gateway is measured alike.
"""

import asyncio
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import aiohttp

PATIENCE_S = 60.0
"""How long the field's clients wait for an answer."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One request. `first_s`: from asking to the first byte of the body. `problem`: "" if the
    whole stream came."""

    model: str
    asked_at: float
    first_s: float
    ended_at: float
    size_bytes: int
    problem: str

    @property
    def first_at(self) -> float:
        return self.asked_at + self.first_s


@dataclass(frozen=True, slots=True)
class Load:
    """What the clients do. `pause_s`: mean pause of a client between its requests."""

    clients: int
    seconds: float
    pause_s: float
    tokens: int
    headers: Mapping[str, str] = field(default_factory=dict)


async def drive(url: str, models: Sequence[str], load: Load) -> list[Answer]:
    """Return the answers of `load.clients` clients of each model, in the order of their ends."""
    answers: list[Answer] = []
    until = time.monotonic() + load.seconds
    names = [model for model in models for _ in range(load.clients)]
    connector = aiohttp.TCPConnector(limit=0)
    timeout = aiohttp.ClientTimeout(PATIENCE_S)
    async with aiohttp.ClientSession(
        connector=connector, timeout=timeout, headers=load.headers
    ) as session:

        async def chat(model: str, number: int) -> None:
            pauses = random.Random(number)
            while time.monotonic() < until:
                await asyncio.sleep(pauses.expovariate(1 / load.pause_s) if load.pause_s else 0)
                answers.append(await timed_chat(session, url, model, load.tokens))

        await asyncio.gather(*(chat(name, number) for number, name in enumerate(names)))
    return answers


async def timed_chat(session: aiohttp.ClientSession, url: str, model: str, tokens: int) -> Answer:
    """Ask once and read to the end."""
    asked_at = first_at = time.monotonic()
    size, problem, ending = 0, "", b""
    messages = [{"role": "user", "content": "where is the cup?"}]
    body = {"model": model, "stream": True, "max_tokens": tokens, "messages": messages}
    try:
        async with session.post(f"{url}/v1/chat/completions", json=body) as reply:
            async for chunk in reply.content.iter_any():
                if not size:
                    first_at = time.monotonic()
                size += len(chunk)
                ending = (ending + chunk)[-80:]
            if reply.status != 200:
                problem = f"{reply.status}: {ending.decode(errors='replace')}"
            elif b"[DONE]" not in ending:
                problem = "the stream ended early"
    except (aiohttp.ClientError, TimeoutError) as error:
        problem = type(error).__name__
    return Answer(model, asked_at, first_at - asked_at, time.monotonic(), size, problem)


@dataclass(frozen=True, slots=True)
class Turns:
    """What the clients saw of several models that take turns. Times in seconds."""

    requests: int
    failed: int
    problems: Mapping[str, int]
    answered: Mapping[str, int]
    """Per model."""
    switches: int
    """Changes of the model in the order of first bytes."""
    gaps_s: Sequence[float]
    """Per switch: from the last byte of one model to the first byte of the next."""
    first_s: Sequence[float]
    """Per request that was answered: from asking to the first byte."""


def turns(answers: Sequence[Answer], models: Sequence[str]) -> Turns:
    good = sorted((one for one in answers if not one.problem), key=lambda one: one.first_at)
    problems = [one.problem for one in answers if one.problem]
    gaps, last_end = [], 0.0
    for before, after in pairwise(good):
        last_end = max(last_end, before.ended_at)
        if before.model != after.model:
            gaps.append(after.first_at - last_end)
    return Turns(
        requests=len(answers),
        failed=len(problems),
        problems={problem: problems.count(problem) for problem in sorted(set(problems))},
        answered={model: sum(one.model == model for one in good) for model in models},
        switches=len(gaps),
        gaps_s=gaps,
        first_s=[one.first_s for one in good],
    )
