"""Busy and failing servers of both APIs: when a request is repeated, after which pause, and when it
is given up. No test waits: the pauses are only written down.
"""

from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from typing import Any

import pytest

from tests.support.llm_apis import PALETTE
from vram_arbiter.reasoner import options
from vram_arbiter.reasoner.llm.config import BUSY_S, LlmConfig
from vram_arbiter.reasoner.llm.http import PAUSE_MAX_S, TRIES_MAX, retry_after_s
from vram_arbiter.reasoner.planner import Episode
from vram_arbiter.schemas.errors import LlmError
from vram_arbiter.schemas.tools import LocateInView

pytestmark = pytest.mark.anyio

pytest.importorskip("httpx", reason="needs the reasoner extra")

LOOK = ("locate_in_view", '{"query": "cube"}')
OVERLOADED = {"error": {"type": "overloaded_error", "message": "overloaded"}}


@pytest.mark.parametrize("status", [429, 503, 529])
def test_a_busy_server_is_asked_again_after_the_pause_that_it_names(
    api: Any, stand_in: Any, decide: Any, status: int
) -> None:
    """Regression: three tries within 1.5 s, whatever the server asked for: a cloud's rate limit of
    a minute ended the task.
    """
    for _ in range(TRIES_MAX + 1):
        stand_in.json(OVERLOADED, status, {"retry-after": "20"})
    stand_in.json(OVERLOADED, status)
    stand_in.json(api.says(LOOK))
    pauses: list[float] = []
    assert decide(pauses=pauses) == LocateInView(query="cube")
    assert pauses[:-1] == [20.0] * (TRIES_MAX + 1)
    assert 0 < pauses[-1] <= PAUSE_MAX_S


def test_a_server_that_stays_busy_is_given_up_when_its_time_is_over(
    stand_in: Any, decide: Any
) -> None:
    for _ in range(64):
        stand_in.json(OVERLOADED, 529)
    pauses: list[float] = []
    with pytest.raises(LlmError, match=r"HTTP status 529: overloaded; .*LLM_BUSY_S"):
        decide(pauses=pauses)
    assert BUSY_S - 2 * PAUSE_MAX_S < sum(pauses) <= BUSY_S
    assert all(pause <= PAUSE_MAX_S for pause in pauses)


async def test_a_refused_try_counts_as_a_failed_request_and_fails_no_decision(
    api: Any, stand_in: Any
) -> None:
    """Regression: a task whose server had refused three times told of one request and no failure:
    the rate limit was not to be seen in its result.
    """
    for _ in range(3):
        stand_in.json(OVERLOADED, 429, {"retry-after": "0"})
    stand_in.json(api.says(LOOK))

    async with api.planner(LlmConfig(stand_in.url + api.base, "m"), PALETTE) as planner:
        assert await planner.decide(Episode("grab it")) == LocateInView(query="cube")
        told = planner.tally.as_result("m")
    assert (told["requests"], told["failed"], told["rejected"]) == (4, 3, 0)


def test_httpx_is_imported_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the first request imported it within its own time limit; on a busy machine that
    was most of it. Programs that ask no language model do not import it.
    """
    imported: list[str] = []
    monkeypatch.setattr(options, "import_httpx", lambda: imported.append("httpx"))
    environ = {f"VRAM_REASONER_LLM_{name}": "http://x" for name in ("BASE_URL", "MODEL")}
    for planner, found in (("scripted", []), ("openai", ["httpx"])):
        flags = options.parser(None).parse_args(["--task", "x", "--planner", planner])
        options.language_model(flags, environ)
        assert imported == found


def test_a_pause_beyond_the_time_is_not_begun(stand_in: Any, decide: Any) -> None:
    stand_in.json(OVERLOADED, 429, {"retry-after": "3600"})
    with pytest.raises(LlmError, match=r"the next try is due in 3600 s"):
        decide()


def test_an_empty_account_is_no_busy_server(stand_in: Any, decide: Any) -> None:
    stand_in.json({"error": {"message": "no credit left"}}, 429, {"x-should-retry": "false"})
    with pytest.raises(LlmError, match="no credit left"):
        decide()
    assert len(stand_in.asked) == 1


def test_a_failing_server_and_a_broken_connection_have_three_tries(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(OVERLOADED, 500)
    stand_in.hangs_up()
    stand_in.json(api.says(LOOK))
    assert decide() == LocateInView(query="cube")
    for _ in range(TRIES_MAX):
        stand_in.json({"error": {"message": "template error"}}, 500)
    with pytest.raises(LlmError, match="template error, 3 times"):
        decide()


def test_how_a_pause_is_named() -> None:
    assert retry_after_s({}) is None
    assert retry_after_s({"retry-after": "soon"}) is None
    assert retry_after_s({"retry-after": "nan"}) is None
    assert retry_after_s({"retry-after": "-3"}) == 0.0
    assert retry_after_s({"retry-after": "1.5", "retry-after-ms": "250"}) == 0.25
    then = datetime.now(UTC) + timedelta(hours=1)
    named = retry_after_s({"retry-after": format_datetime(then, usegmt=True)})
    assert named is not None
    assert 3500 < named <= 3600
