"""`vramctl top` on a real daemon with a simulated GPU, driven by Textual's pilot; its lines alone;
and the program on a terminal of its own."""

import contextlib
import json
import os
import pty
import re
import select
import subprocess
import sys
import termios
import unicodedata
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import anyio
import pytest

pytest.importorskip("textual", reason="the extra `top`")
from rich.cells import cell_len
from textual.pilot import Pilot
from textual.widgets import Static

from tests.support.process import ArbiterProcess, vramctl
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.cli.top import feed as feeds
from vram_arbiter.clients.cli.top import gpus
from vram_arbiter.clients.cli.top.app import Top
from vram_arbiter.clients.cli.top.feed import Feed
from vram_arbiter.clients.cli.top.gpus import Samples
from vram_arbiter.clients.cli.top.leases import Leases
from vram_arbiter.clients.cli.top.rows import ORDERS, Table, brief_bytes, rows_of
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.sync import Client, Lease
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import Acquire
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.schemas.wire.views import DemandView, GpuView, SensorsView

STRANGER = 65534
HOSTILE = "x\x1b[2J\u202e\r\n名前" * 20


def lease_spec(consumer: str, gib: float, priority: int = 50) -> LeaseSpec:
    size = int(gib * GIB)
    return LeaseSpec(
        consumer=consumer,
        model_id=consumer,
        footprint=Footprint(size, size, 0),
        min_residency_s=0.0,
        priority=priority,
        ttl_s=600.0,
    )


@pytest.fixture(scope="module")
def daemon() -> Iterator[ArbiterProcess]:
    """A daemon of its own for this file: the last test kills it."""
    arbiter = ArbiterProcess(prepared=True).start()
    yield arbiter
    arbiter.close()


@pytest.fixture(scope="module")
def held_detector(daemon: ArbiterProcess) -> Iterator[Lease]:
    """A holder in use; `grab` and `vlm` wait for its bytes."""
    with contextlib.ExitStack() as clients:
        holder, *waiters = (
            clients.enter_context(Client(name, endpoint=daemon.endpoint))
            for name in ("detector", "grab", "vlm")
        )
        lease = holder.acquire(lease_spec("detector", 5, priority=90))
        lease.ready(5 * GIB)
        clients.enter_context(lease.use("detect"))
        for client, gib in zip(waiters, (6, 7), strict=True):
            client.ask(Acquire(client.name, lease_spec(client.name, gib)))
        yield lease


@asynccontextmanager
async def top(endpoint: str, width: int = 80, height: int = 24) -> AsyncIterator[Pilot[None]]:
    """The running view, once it has its first status."""
    async with AsyncClient("top", endpoint=endpoint, role="observer") as client:
        app = Top(Feed(client))
        async with app.run_test(size=(width, height)) as pilot:
            await until_shown(pilot, lambda: app._feed.status is not None)
            yield pilot


async def until_shown(pilot: Pilot[None], true: Callable[[], bool]) -> None:
    with anyio.fail_after(PATIENCE_S):
        while not true():
            await pilot.pause(0.01)


def screen(pilot: Pilot[None]) -> list[str]:
    """The text that the terminal shows."""
    lines = pilot.app.screen._compositor.render_strips()
    return ["".join(segment.text for segment in line).rstrip() for line in lines]


def words(line: str) -> str:
    return " ".join(line.split())


def names(pilot: Pilot[None]) -> list[str]:
    return [row.lease.consumer for row in pilot.app.screen_stack[0].query_one(Leases).rows]


def keys(pilot: Pilot[None]) -> str:
    return str(pilot.app.screen_stack[0].query_one("#keys", Static).content)


# -- with a daemon
@pytest.mark.e2e
@pytest.mark.anyio
async def test_80_by_24(daemon: ArbiterProcess, held_detector: Lease) -> None:
    async with top(daemon.endpoint) as pilot:
        await until_shown(pilot, lambda: "CONSUMER" in screen(pilot)[3])
        shown = screen(pilot)
        assert len(shown) == 24
        assert shown[0].startswith("arbiter serving · 3 leases, 2 waiting · operator")
        assert shown[1].startswith("GPU 0 · charged 5.00 GiB of 8.00 GiB · measured ")
        assert shown[2].startswith("[████")
        assert shown[2].endswith(" 4 min")
        assert words(shown[3]) == "CONSUMER STATE TIER DECLARED CHARGED MEASURED USES ETA"
        assert words(shown[4]) == "detector held GPU 0 5.00 GiB 5.00 GiB 5.00 GiB 1"
        assert words(shown[5]) == "grab queued #1 - 6.00 GiB 6.00 GiB 0 ?"
        async with AsyncClient("asks", endpoint=daemon.endpoint) as client:
            (why,) = (await client.why("grab")).leases
        assert "is in use and has priority 90" in why.next
        assert shown[6] == f"  └ {why.next}", "the words are the arbiter's"
        assert shown[8] == "  └ waits behind grab as number 2"
        assert shown[-1].startswith("s sort queue  e evict  p pin  d drain  q")
        await pilot.press("j")
        await pilot.pause()
        assert " ".join(why.text.split()) in words(" ".join(screen(pilot)[-12:-2])), (
            "the list leaves room: the reason is shown in full"
        )
        await until_shown(pilot, lambda: "queued" in screen(pilot)[-2])  # of before its start
        await pilot.press("e")
        await pilot.pause()
        assert keys(pilot) == "grab waits: it has no bytes to evict"
        assert len(pilot.app.screen_stack) == 1, "no dialog for what would be refused"
        async with AsyncClient("gateway", endpoint=daemon.endpoint) as client:
            await client.demand({"llm": (3, 12)})
            await until_shown(pilot, lambda: "llm 3 12 gateway" in map(words, screen(pilot)))


@pytest.mark.e2e
@pytest.mark.anyio
async def test_a_phone_sorts_and_is_turned(daemon: ArbiterProcess, held_detector: Lease) -> None:
    async with top(daemon.endpoint, 60, 24) as pilot:
        await until_shown(pilot, lambda: "CONSUMER" in screen(pilot)[3])
        assert all(cell_len(line) <= 60 for line in screen(pilot))
        assert words(screen(pilot)[3]) == "CONSUMER STATE CHARGED MEASURED USES ETA"
        await pilot.press("s", "s")
        assert names(pilot) == ["vlm", "grab", "detector"], "by charged bytes"
        await pilot.press(*"s" * (len(ORDERS) - 2))
        assert names(pilot)[0] == "detector", "by the queue again"
        await pilot.resize_terminal(150, 40)
        await until_shown(pilot, lambda: "PID" in screen(pilot)[3])
        assert held_detector.lease_id in screen(pilot)[4]


@pytest.mark.e2e
@pytest.mark.anyio
async def test_orders_need_a_confirmation(daemon: ArbiterProcess, held_detector: Lease) -> None:
    async with top(daemon.endpoint) as pilot:
        await until_shown(pilot, lambda: names(pilot)[:1] == ["detector"])
        await pilot.press("e")
        assert any("It finishes 1 use first." in line for line in screen(pilot))
        for no in ("n", "escape", "enter"):  # the focus is on No
            if no != "n":
                await pilot.press("e")
            await pilot.press(no)
            await pilot.pause()
            assert keys(pilot) == "not done: evict"
        assert held_detector.state == "held"
        await pilot.press("p", "y")
        await until_shown(pilot, lambda: "is pinned" in keys(pilot))
        await until_shown(pilot, lambda: "held pin" in "\n".join(screen(pilot)))
        await pilot.press("e", "y")
        await until_shown(pilot, lambda: "an operator pinned it (unpin it first)" in keys(pilot))
        await pilot.press("p", "y")
        await until_shown(pilot, lambda: "no longer pinned" in keys(pilot))
        await pilot.press("d", "right", *["shift+tab"] * 2, *"swap", "enter", "enter")
        await until_shown(pilot, lambda: "drained by vramctl" in "\n".join(screen(pilot)))
        await pilot.press("d", "y")
        await until_shown(pilot, lambda: "drained by" not in "\n".join(screen(pilot)[:4]))
        await until_shown(pilot, lambda: "held pin" not in "\n".join(screen(pilot)))
        await pilot.press("e", "y")
        await until_shown(pilot, lambda: "finishes 1 use, then unloads" in keys(pilot))
        await until_shown(pilot, lambda: "revoking" in "\n".join(screen(pilot)))
    history = vramctl("history", "--kind", "operator", "--json", environ=daemon.environ)
    told_lines = [(one["action"], one["reason"]) for one in json.loads(history.stdout)["events"]]
    assert [action for action, _ in told_lines] == ["pin", "unpin", "drain", "resume", "evict"]
    assert [reason for _, reason in told_lines[1:3]] == ["by hand in vramctl top", "swap"]


@pytest.mark.e2e
@pytest.mark.anyio
@pytest.mark.skipif(os.getuid() != 0, reason="becomes another user")
async def test_another_user_reads_why_it_may_not(
    daemon: ArbiterProcess, held_detector: Lease, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal is the arbiter's own, to a process of another user."""
    daemon.runtime.chmod(0o755)
    (daemon.runtime / "arbiter.sock").chmod(0o666)

    def ask_as_stranger(*_: object, **__: object) -> dict[str, object]:
        words = ("drain", "-r", "why", "--json")
        done = vramctl(*words, user=STRANGER, environ=daemon.environ)
        return {"ok": False, **json.loads(done.stdout)}

    monkeypatch.setattr(feeds, "ask", ask_as_stranger)
    async with top(daemon.endpoint) as pilot:
        await until_shown(pilot, lambda: "e p d: operators only" in keys(pilot))
        assert "· observer" in screen(pilot)[0]
        await pilot.press("e")
        await pilot.pause()
        assert len(pilot.app.screen_stack) == 1, "no confirmation for what is refused"
        assert keys(pilot).startswith("only the daemon's user, root and the operators' group")


@pytest.mark.e2e
@pytest.mark.anyio
async def test_the_daemon_is_lost_and_comes_back(
    daemon: ArbiterProcess, held_detector: Lease
) -> None:
    """Last of this file: it kills the daemon."""
    async with top(daemon.endpoint) as pilot:
        await until_shown(pilot, lambda: "detector" in names(pilot))
        await anyio.to_thread.run_sync(daemon.kill)
        await until_shown(pilot, lambda: "cannot be reached, since" in screen(pilot)[0])
        assert "detector" in names(pilot), "what it said last stays"
        await pilot.press("p", "y")
        await until_shown(pilot, lambda: "it was killed, its socket is left over" in keys(pilot))
        await anyio.to_thread.run_sync(daemon.start)
        await until_shown(pilot, lambda: screen(pilot)[0].startswith("arbiter "))
        await until_shown(pilot, lambda: "detector" in names(pilot))


@pytest.mark.e2e
def test_the_program_on_a_terminal_without_color(arbiter_daemon: ArbiterProcess) -> None:
    """It draws, `q` ends it with 0, and NO_COLOR is heeded."""
    master, terminal = pty.openpty()
    termios.tcsetwinsize(terminal, (24, 80))
    process = subprocess.Popen(
        [sys.executable, "-m", "vram_arbiter.clients", "top"],
        env={**arbiter_daemon.environ, "TERM": "xterm-256color", "NO_COLOR": "1"},
        stdin=terminal, stdout=terminal, stderr=terminal,
    )  # fmt: skip
    os.close(terminal)
    shown, asked = b"", False
    try:
        with contextlib.suppress(OSError):  # the other side is closed: it has ended
            while select.select([master], [], [], PATIENCE_S)[0]:
                shown += os.read(master, 65_536)
                if b"no leases" in shown and not asked:
                    asked = True
                    os.write(master, b"q")
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        os.close(master)
    assert b"arbiter serving" in shown
    assert re.search(rb"\x1b\[[0-9;]*\b(3[0-8]|4[0-8]|9[0-7])\b[0-9;]*m", shown) is None


def test_without_a_terminal_it_names_what_works(tmp_path: Path) -> None:
    done = vramctl("top", environ={**os.environ, "VRAM_ARBITER_RUNTIME": str(tmp_path)})
    assert done.returncode == 2
    assert "needs a terminal" in done.stderr
    assert "`vramctl status` once, or `vramctl history -f`" in done.stderr


# -- lines alone
@pytest.fixture(scope="module")
def told_lines(daemon: ArbiterProcess, held_detector: Lease) -> StatusReply:
    with Client("asks", endpoint=daemon.endpoint) as client:
        return client.status(details=True)


@pytest.mark.parametrize("width", [60, 79, 80, 99, 120, 160])
@pytest.mark.e2e
def test_columns_fit_and_obey_no_name(told_lines: StatusReply, width: int) -> None:
    hostile = tuple(
        replace(one, consumer=HOSTILE, model=HOSTILE, charge_bytes=999 * GIB + MIB)
        for one in told_lines.leases
    )
    demands = (DemandView(HOSTILE, 3, 12, HOSTILE),) * 9
    poisoned = replace(
        told_lines, leases=hostile, demands=demands, drained=HOSTILE, problems=(HOSTILE,)
    )
    table = Table(width)
    rows = rows_of(poisoned)
    lines = [table.head(), *(table.line(row) for row in rows), *(table.reason(row) for row in rows)]
    assert {cell_len(line) for line in lines[: 1 + len(rows)]} == {width}
    lines += gpus.panel(poisoned, [Samples()], width, 24)
    lines += [gpus.header(poisoned, "operator", width)]
    requests = gpus.demands(poisoned, width, 24)
    assert (len(requests), requests[-1]) == (4, "and 7 more"), "the list of leases needs the room"
    lines += requests
    assert all(cell_len(line) <= width for line in lines)
    lines += [line for row in rows for line in gpus.selected_lines(row)]  # the screen wraps them
    said = "".join([*lines, *gpus.notices(poisoned)])
    assert not [letter for letter in said if unicodedata.category(letter) in ("Cc", "Cf")]
    for order in ORDERS:
        assert len(sorted(rows, key=ORDERS[order])) == len(rows)


def test_a_gpu_of_two_lines_shows_its_sensors() -> None:
    gpu = GpuView("GPU-1", 0, "RTX", "nvml", 8 * GIB, 0, 0, 0, 0, 0.1, 0, None, ())
    known = replace(gpu, sensors=SensorsView(0.87, 64.0))
    told, _ = gpus.gpu_lines(known, Samples(), 80, brief=False)
    assert told == "GPU 0 · charged 0 of 8.00 GiB · measured 0 · 87 % busy, 64 °C · RTX"


def test_a_sparkline_shows_the_largest_reading_of_each_interval() -> None:
    samples = Samples()
    step = gpus.SPAN_S / 8
    for at, share in ((0.5, 8), (1.5, 0), (1.7, 4), (4.5, None), (6.5, 8)):
        samples.add(at * step, None if share is None else share * GIB)
    samples.add(7.99 * step, 2 * GIB)
    assert samples.sparkline(8, 8 * GIB) == "█▅▅▅  █▃"
    samples.add(20 * step, 0)
    assert len(samples.points) == 1, "older readings are forgotten"
    assert Samples().sparkline(3, GIB) == "   "


def test_sizes_are_short() -> None:
    assert [brief_bytes(n) for n in (0, 450 * MIB, 5 * GIB + 340 * MIB, 2000 * GIB, None)] == [
        "0", "450 MiB", "5.33 GiB", "2000 GiB", "?"
    ]  # fmt: skip
