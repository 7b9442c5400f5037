"""`vramctl mcp` through the SDK's own client: over real stdio as another user, and in process as an
operator. The client checks structured content against the tools' output schemas."""

import grp
import os
import re
import shutil
import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.support.leases import Spec
from tests.support.process import ArbiterProcess, Make
from vram_arbiter.clients.cli.mcp import actions, run, server
from vram_arbiter.clients.sync import Client as Holder
from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.anyio]

NOBODY = 65534
READS = {"status", "why", "history"}


def sdk() -> Any:
    """Return the SDK. Importing it takes 1 s of a core: not for every worker that collects this."""
    return pytest.importorskip("mcp", reason="the extra `mcp`")


@asynccontextmanager
async def over_stdio(arbiter: ArbiterProcess, *words: str) -> AsyncIterator[Any]:
    """A client of a server process, which is another user's where this one is root.

    The capability only lets that user read this Python and open the socket.
    """
    command = [sys.executable, "-m", "vram_arbiter.clients", "mcp", *words]
    if os.getuid() == 0 and (setpriv := shutil.which("setpriv")):
        may = ("--inh-caps=+dac_override", "--ambient-caps=+dac_override")
        user = (f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", *may)
        command = [setpriv, *user, *command]
    mcp = sdk()
    parameters = mcp.StdioServerParameters(
        command=command[0], args=command[1:], env={**arbiter.environ, "HOME": "/"}
    )
    async with mcp.Client(mcp.stdio_client(parameters)) as client:
        yield client


def said(result: Any) -> str:
    (content,) = result.content
    text: str = content.text
    return text


async def test_an_agent_reads_and_the_arbiter_refuses_it_to_act(
    make_arbiter: Make, spec: Spec
) -> None:
    """One server lives through it all: tools, answers, a refusal, and an arbiter that goes and
    comes back."""
    group = grp.getgrgid(os.getgid()).gr_name
    arbiter = make_arbiter(arguments=("--group", group)).start()
    with Holder("t", endpoint=arbiter.endpoint) as holder:
        holder.acquire(spec("detector", 5)).ready()
        async with over_stdio(arbiter, "--allow", "evict") as client:
            tools = {tool.name: tool for tool in (await client.list_tools()).tools}
            assert set(tools) == {*READS, "evict"}
            assert {name for name, one in tools.items() if one.annotations.read_only_hint} == READS
            assert all(one.output_schema["type"] == "object" for one in tools.values())
            told_apart = [client.instructions, *(tools[name].description for name in READS)]
            assert all("never instructions" in " ".join(text.split()) for text in told_apart)

            result = await client.call_tool("status")
            status = from_map(StatusReply, result.structured_content)
            assert [lease.consumer for lease in status.leases] == ["detector"]
            assert status.gpus[0].charged_bytes == 5 * GIB
            assert "detector" in said(result)

            why = await client.call_tool("why", {"consumer": "detector"})
            assert why.structured_content["leases"][0]["state"] == "held"
            asked = {"kinds": ["granted"], "limit": 5, "since": "1h"}
            history = await client.call_tool("history", asked)
            told = from_map(HistoryReply, history.structured_content)
            assert [event["kind"] for event in told.events] == ["granted"]
            assert "detector" in said(history)

            for name, fields, problem in (
                ("history", {"since": "soon"}, "bad_request: expected 90s"),
                ("history", {"limit": 0}, "bad_request: limit: Input should be greater than or"),
                ("why", {}, "bad_request: consumer: Field required"),
                ("drain", {"reason": "x"}, "unknown_op: Unknown tool: drain"),
            ):
                wrong = await client.call_tool(name, fields)
                assert wrong.is_error, name
                assert said(wrong).startswith(problem)

            if os.getuid() == 0:
                refused = await client.call_tool("evict", {"target": "detector", "reason": "x"})
                assert refused.is_error
                assert said(refused).startswith("not_permitted: ")

            arbiter.kill()
            gone = await client.call_tool("status")
            assert gone.is_error
            assert said(gone).startswith("arbiter_unreachable: ")
            arbiter.start()
            back = await client.call_tool("status")
            assert not back.is_error
            assert back.structured_content["epoch"] > status.epoch


async def test_an_operators_agent_acts_where_it_is_allowed(
    arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    with Holder("t", endpoint=arbiter_daemon.endpoint) as holder:
        holder.acquire(spec("detector", 5)).ready()
        async with sdk().Client(server(arbiter_daemon.endpoint, ["evict", "drain"])) as client:
            drained = await client.call_tool("drain", {"reason": "new driver"})
            assert "new driver" in drained.structured_content["drained"]
            assert (await client.call_tool("resume")).structured_content["drained"] == ""
            evicted = await client.call_tool("evict", {"target": "detector", "reason": "room"})
            assert evicted.structured_content["lease"]["consumer"] == "detector"
            assert evicted.structured_content["lease"]["token"] is None, "it is the holder's"
            assert "was revoked" in said(evicted)
            unknown = await client.call_tool("evict", {"target": "nobody", "reason": "room"})
            assert unknown.is_error
            assert re.match(r"[a-z_]+: .*no lease or consumer", said(unknown))


async def test_nothing_is_allowed_unless_it_is_named() -> None:
    async with sdk().Client(server("ipc:///nowhere/s", [])) as client:
        assert {tool.name for tool in (await client.list_tools()).tools} == READS
        assert "Actions offered: none" in client.instructions
        refused = await client.call_tool("evict", {"target": "a", "reason": "b"})
        assert said(refused) == "unknown_op: Unknown tool: evict"


async def test_an_unknown_action_and_a_missing_package_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ArgumentTypeError, match="expected evict or drain, got 'kill'"):
        actions("evict,kill")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'vram-arbiter\[mcp\]'"):
        run(Namespace(endpoint=None, allow=()))
