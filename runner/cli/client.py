"""Parts that the client commands of `vram-runner` share: they talk to a running runner."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping

from vram_arbiter.clients.cli.arguments import positive
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.runtime.printable import printable_lines

WAIT_S = 60.0  # a simulator starts within half a minute, on a busy machine later


def add_client_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--endpoint", help="the runner's endpoint; default ipc://RUNTIME/runner.sock"
    )
    parser.add_argument(
        "--wait", type=positive, default=WAIT_S, metavar="SECONDS",
        help="wait this long for a runner that is starting; default %(default)g",
    )  # fmt: skip


def client_of(args: argparse.Namespace) -> RunnerClient:
    """Return the client that the flags ask for; it connects at its first call."""
    return RunnerClient(args.endpoint, connect_timeout_s=args.wait)


def show(text: str) -> None:
    """Print text of another program, its control characters escaped."""
    print(printable_lines(text), flush=True)


def note(text: str) -> None:
    """Print a remark for people, apart from the answer."""
    print(printable_lines(text), file=sys.stderr, flush=True)


def show_json(answer: Mapping[str, object]) -> None:
    """Print an answer as one line of JSON, without what belongs to the wire."""
    fields = {key: value for key, value in answer.items() if key not in ("re", "ok", "push")}
    print(json.dumps(fields), flush=True)
