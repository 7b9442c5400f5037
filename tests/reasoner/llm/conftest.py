"""Planners of both APIs against a local server."""

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.chat_server import StandIn
from tests.support.llm_apis import KEY, PALETTE, Anthropic, OpenAi
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.planner import Episode


@pytest.fixture
def stand_in() -> Iterator[StandIn]:
    with StandIn() as server:
        yield server


@pytest.fixture(params=[OpenAi, Anthropic])
def api(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def decide(api: Any, stand_in: Any) -> Callable[..., Any]:
    def run(
        episode: Episode | None = None,
        *,
        timeout_s: float = 20.0,
        palette: Palette = PALETTE,
        pauses: list[float] | None = None,
        **more: Any,
    ) -> Any:
        config = LlmConfig(stand_in.url + api.base, "m", KEY, timeout_s)

        async def pause(seconds: float) -> None:
            if pauses is not None:
                pauses.append(seconds)

        async def once() -> Any:
            async with api.planner(config, palette, pause=pause, **more) as planner:
                return await planner.decide(episode or Episode("grab the red cube"))

        return asyncio.run(once())

    return run
