"""`vramctl history`: events with their reasons, by number, time, kind or consumer, or live.

The daemon filters by kind; consumers and times are filtered here, page by page.
"""

import argparse
import asyncio
import contextlib
import datetime
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from vram_arbiter.clients.cli import arguments, text
from vram_arbiter.clients.cli.replies import ENVELOPE, OK, answer
from vram_arbiter.clients.net import request
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire.requests import History

LIMIT = 50
PAGE = 2000  # events in one reply; more would not fit a message
NEVER = 1 << 62  # no event has a number beyond it

DESCRIPTIONS = {
    "history": "List what happened: grants, evictions, verdicts, with their reasons. With --follow "
    "--json, one JSON object a line."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "-n",
        "--limit",
        type=arguments.count(1, 5000),
        default=LIMIT,
        help="at most this many events (default: %(default)s)",
    )
    parser.add_argument(
        "--after",
        type=arguments.count(0, NEVER),
        help="the first events after this number (default: the newest)",
    )
    parser.add_argument(
        "--since",
        type=since,
        dest="since_wall_s",
        metavar="TIME",
        help="since 90s, 10m, 2h or 1d ago, 14:30, or '2026-11-21 14:30'",
    )
    parser.add_argument(
        "-c", "--consumer", action="append", default=[], help="only this consumer; repeatable"
    )
    parser.add_argument(
        "--kind", action="append", type=kind, default=[], help="only this kind; repeatable"
    )
    parser.add_argument(
        "-f", "--follow", action="store_true", help="then follow new events, until Ctrl-C"
    )
    parser.add_argument(
        "-a",
        "--all",
        action="store_true",
        help="also quiet events, such as uses; --json always has them",
    )
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    quiet = args.all or args.as_json
    wanted = Wanted(args.kind, args.consumer, args.since_wall_s, args.limit, args.after, quiet)
    if args.follow:
        return asyncio.run(follow(wanted, as_json=args.as_json, endpoint=args.endpoint))
    return history(wanted, as_json=args.as_json, endpoint=args.endpoint)


def kind(written: str) -> str:
    """Argparse type: a kind of event. A mistyped one would look like a history without such."""
    from vram_arbiter.schemas.wire.notes import DAEMON_KINDS, NOTES

    known = {*NOTES, *DAEMON_KINDS}
    if written not in known:
        from vram_arbiter.schemas.findings import did_you_mean

        raise argparse.ArgumentTypeError(f"{written!r} is not one{did_you_mean(written, known)}")
    return written


AGO = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d)")
UNITS = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


def since(written: str, now_wall_s: float | None = None) -> float:
    """Argparse type of `--since`: `90s`, `10m`, `2h`, `1d` ago; `14:30` or `14:30:05`, the last
    time it was so late; or a date, `2026-11-21 14:30`. Wall seconds."""
    now = time.time() if now_wall_s is None else now_wall_s
    if ago := AGO.fullmatch(written.strip()):
        return now - float(ago[1]) * UNITS[ago[2]]
    if ":" in written and "-" not in written:  # a bare number is no time of day
        with contextlib.suppress(ValueError):
            clock = datetime.time.fromisoformat(written.strip())
            today = datetime.datetime.fromtimestamp(now)
            at = datetime.datetime.combine(today.date(), clock).timestamp()
            return at if at <= now else at - UNITS["d"]
    with contextlib.suppress(ValueError):
        return datetime.datetime.fromisoformat(written.strip()).timestamp()
    expected = "90s, 10m, 2h, 1d, 14:30 or '2026-11-21 14:30'"
    raise argparse.ArgumentTypeError(f"expected {expected}, got {written!r}")


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which events."""

    kinds: Sequence[str] = ()
    consumers: Sequence[str] = ()
    since_wall_s: float | None = None
    limit: int = LIMIT
    after: int | None = None
    quiet: bool = True
    """Also quiet events; a quiet kind that `kinds` names is always wanted."""

    def keeps(self, event: JsonMap) -> bool:
        """Return whether to show this event. An eviction is about the lease's consumer and about
        the waiter's."""
        return self.fits(event) and not self.folds(event)

    def folds(self, event: JsonMap) -> bool:
        """Return whether this event is left out because it is quiet."""
        if self.quiet or not text.is_quiet(event):
            return False
        return event["kind"] not in text.QUIET_KINDS.intersection(self.kinds)

    def too_old(self, event: JsonMap) -> bool:
        """Return whether an event is of a time that is not wanted any more."""
        return self.since_wall_s is not None and event["at_wall_s"] < self.since_wall_s

    def fits(self, event: JsonMap) -> bool:
        return (
            (not self.kinds or event["kind"] in self.kinds)
            and (not self.consumers or any(about(event, name) for name in self.consumers))
            and not self.too_old(event)
        )


def about(event: JsonMap, consumer: str) -> bool:
    return consumer in (event.get("consumer"), event.get("wanted_by"))


def history(wanted: Wanted, *, as_json: bool = False, endpoint: str | None = None) -> int:
    """The newest events that are wanted, or the first ones after a number."""

    def shown(reply: Message) -> list[str]:
        lines = [text.event_line(event) for event in reply["events"]]
        if len(lines) < wanted.limit:  # all that there is was looked at
            lines += [
                f"no such event of {name!r}: consumers of leases are in `vramctl status`"
                for name in wanted.consumers
                if not any(about(event, name) for event in reply["events"])
            ]
        if folded := reply.get("folded"):
            lines.append(f"({text.plural(folded, 'quiet event')} not shown: --all)")
        return lines

    hidden = ENVELOPE | {"epoch"}
    return answer(
        partial(collect, wanted, endpoint),
        as_json=as_json,
        lines=shown,
        hidden=hidden,
    )[0]


def collect(wanted: Wanted, endpoint: str | None) -> Message:
    """Page back from the newest until there are enough, keeping the tail; with `after`, to that
    number, keeping the head. Raises ArbiterUnreachable."""
    found: list[Any] = []
    folded: list[int] = []  # numbers of quiet events
    before = NEVER
    while (reply := page(wanted, before, endpoint)).get("ok"):
        events = reply.get("events", [])
        fitting = [event for event in events if wanted.fits(event)]
        found[:0] = [event for event in fitting if not wanted.folds(event)]
        if wanted.after is not None:
            del found[wanted.limit :]
        folded += [event["seq"] for event in fitting if wanted.folds(event)]
        enough = wanted.after is None and len(found) >= wanted.limit
        if enough or len(events) < PAGE or wanted.too_old(events[0]):
            shown = found[-wanted.limit :]
            first = shown[0]["seq"] if shown else 0
            told = {} if wanted.quiet else {"folded": sum(seq > first for seq in folded)}
            return {**reply, "events": shown, **told}
        before = events[0]["seq"]
    return reply


def page(wanted: Wanted, before: int, endpoint: str | None) -> Message:
    """Ask for the newest events below a number. Raises ArbiterUnreachable."""
    asked = History(wanted.after or 0, PAGE, tuple(wanted.kinds), before)
    return request.ask(asked, endpoint)


async def follow(wanted: Wanted, *, as_json: bool = False, endpoint: str | None = None) -> int:
    """The newest events, then every further one as it happens, until Ctrl-C; also across restarts
    of the arbiter.

    Raises ArbiterUnreachable if no arbiter answers at first.
    """
    from vram_arbiter.clients.client import AsyncClient
    from vram_arbiter.clients.feed import Cursor
    from vram_arbiter.clients.feed import follow as feed

    def tell(event: JsonMap) -> None:
        if wanted.keeps(event):
            print(json.dumps(event) if as_json else text.event_line(event), flush=True)

    client = AsyncClient(
        "vramctl history", endpoint=endpoint, role="observer", connect_timeout_s=request.TIMEOUT_S
    )
    async with client:
        newest = await client.history(NEVER, 1)  # whatever comes later is followed
        past = await asyncio.to_thread(collect, wanted, client.endpoint)
        told = 0
        for event in past.get("events", []):
            tell(event)
            told = event["seq"]
        cursor = Cursor({newest.numbering: newest.last_seq})
        async with contextlib.aclosing(feed(client, cursor)) as batches:
            async for events in batches:
                for event in events:
                    if event["seq"] > told or cursor.numbering != newest.numbering:
                        tell(event)
    return OK
