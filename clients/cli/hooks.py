"""`vramctl hooks`: `run` delivers events to commands and webhooks, `test` fires one rule."""

import argparse
import asyncio
import logging
import os
import signal
import sys
from collections.abc import Mapping
from contextlib import aclosing
from pathlib import Path
from shutil import which
from typing import Final

from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.replies import NO, OK, USAGE
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.feed import Cursor, follow
from vram_arbiter.clients.hooks import webhook
from vram_arbiter.clients.hooks.command import run_command
from vram_arbiter.clients.hooks.events import Delivery, environ_of, sample
from vram_arbiter.clients.hooks.runner import Runner
from vram_arbiter.clients.hooks.state import Saved, StateFile
from vram_arbiter.schemas.config.hooks import Hook, HooksConfig, load_hooks
from vram_arbiter.schemas.errors import ActionFailed, ArbiterUnreachable, ConfigError
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.systemd import Notifier
from vram_arbiter.schemas.yamltext import check_owner, read_text

log = logging.getLogger(__name__)

NAME: Final = "hooks.yaml"
FOLDER: Final = "vram-hooks"
RETRY_S: Final = 1.0
"""How long an arbiter is waited for at the start, and between two attempts."""

DESCRIPTIONS = {
    "hooks": "Run commands and webhooks when the arbiter grants, revokes, evicts, denies, or sees "
    "pressure or a stowaway. The rules are in hooks.yaml. `run` goes on until SIGTERM, also across "
    "restarts of the arbiter; `run --check` says what would run; `test RULE` fires one rule with a "
    "sample event."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    run_parser = actions.add_parser("run", help="deliver events until SIGTERM")
    run_parser.add_argument(
        "--check", action="store_true", help="check the rules, say what would run, and exit"
    )
    run_parser.add_argument(
        "--state",
        type=Path,
        metavar="FILE",
        help="file of what was delivered (default: hooks.json in STATE_DIRECTORY, else in "
        f"~/.local/state/{FOLDER})",
    )
    run_parser.add_argument("--log-format", choices=logs.FORMS, default="human")
    test_parser = actions.add_parser("test", help="fire one rule with a sample event")
    test_parser.add_argument("rule", metavar="RULE", help="name of the rule")
    test_parser.add_argument("--on", metavar="EVENT", help="one of its events (default: the first)")
    for one in (run_parser, test_parser):
        one.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            help=f"file of the rules (default: {NAME} in CONFIGURATION_DIRECTORY, "
            "~/.config/vram-arbiter or /etc/vram-arbiter)",
        )
        arguments.add_endpoint(one)


def run(args: argparse.Namespace) -> int:
    try:
        return _run(args)
    except ConfigError as error:
        terminal.complain("vramctl", error)  # every mistake on a line of its own
        return USAGE


def _run(args: argparse.Namespace) -> int:
    config = read_config(args.config or find_config(os.environ))
    endpoint = args.endpoint or arbiter_endpoint(os.environ, os.getuid())
    if args.action == "test":
        return asyncio.run(fire(config, args.rule, args.on, endpoint))
    if args.check:
        print("\n".join(plan(config)))
        return OK
    path = args.state or state_path(os.environ)
    logs.set_up("vramctl hooks", "info", args.log_format, "%(levelname)s %(message)s")
    state = StateFile(path)
    state.open()
    try:
        return asyncio.run(serve(config, endpoint, state))
    finally:
        state.close()


def find_config(environ: Mapping[str, str]) -> Path:
    """Return the file of the rules. Raises ConfigError where there is none."""
    home = environ.get("XDG_CONFIG_HOME") or f"{environ.get('HOME', '/')}/.config"
    folders = [f"{home}/vram-arbiter", "/etc/vram-arbiter"]
    if under_systemd := environ.get("CONFIGURATION_DIRECTORY"):
        folders.insert(0, under_systemd.split(":")[0])
    places = [Path(folder, NAME) for folder in folders]
    for place in places:
        if place.exists():
            return place
    raise ConfigError(
        f"no rules: there is none of {', '.join(map(str, places))}",
        hint="write one (`configs/hooks.yaml` shows every key), or name it with --config",
    )


def state_path(environ: Mapping[str, str]) -> Path:
    if under_systemd := environ.get("STATE_DIRECTORY"):
        # systemd's own link for a user that exists only while the unit runs
        return Path(under_systemd.split(":")[0]).resolve() / "hooks.json"
    home = environ.get("XDG_STATE_HOME") or f"{environ.get('HOME', '/')}/.local/state"
    return Path(home, FOLDER, "hooks.json")


def read_config(path: Path) -> HooksConfig:
    """Return the rules, checked as far as possible without running them. Raises ConfigError."""
    text = read_text(path, hint="--config needs a readable YAML file", trusted=True)
    config = load_hooks(text, str(path))
    for hook in config.hooks:
        if hook.command is not None:
            _check_program(hook.command[0], f"{path}: {hook.name}")
        if hook.headers_file is not None:
            webhook.read_headers(hook.headers_file)
    return config


def _check_program(name: str, where: str) -> None:
    """Raises ConfigError for what cannot be started, and for what other users may have written."""
    program = which(name)
    if program is None:
        raise ConfigError(
            f"{where}: {name} is not a program that can be started",
            hint="write its absolute path, and chmod +x it",
        )
    opened = os.open(program, os.O_PATH | os.O_CLOEXEC)
    try:
        check_owner(Path(program), opened)
    finally:
        os.close(opened)


def plan(config: HooksConfig) -> list[str]:
    """Return what would run, a rule at a time."""
    lines = []
    for hook in config.hooks:
        about = "" if hook.consumer == "*" else f" of {hook.consumer}"
        if hook.command is not None:
            does = f"runs {' '.join(map(repr, hook.command))}, at most {hook.timeout_s:g} s"
        else:
            headers = f" with the headers of {hook.headers_file}" if hook.headers_file else ""
            does = f"posts to {hook.webhook}{headers}, {hook.attempts} times at most"
        lines.append(printable(f"{hook.name}: on {', '.join(hook.on)}{about} {does}"))
    return lines


async def act(hook: Hook, delivery: Delivery, endpoint: str) -> None:
    """Perform one delivery. Raises ActionFailed."""
    if hook.command is not None:
        line = delivery.body + b"\n"
        await run_command(hook.command, line, environ_of(delivery, endpoint), hook.timeout_s)
    else:
        await webhook.deliver(hook, delivery, lambda said: log.warning("%s: %s", hook.name, said))


async def fire(config: HooksConfig, rule: str, on: str | None, endpoint: str) -> int:
    """Fire one rule with a sample event. Return the exit code."""
    hook = next((one for one in config.hooks if one.name == rule), None)
    if hook is None:
        known = ", ".join(one.name for one in config.hooks)
        raise ConfigError(f"unknown hook {rule!r}", hint=f"hooks: {known}")
    if on is not None and on not in hook.on:
        raise ConfigError(f"{rule} is not for {on!r}", hint=f"events: {', '.join(hook.on)}")
    delivery = sample(hook, on or hook.on[0])
    print(delivery.body.decode(), flush=True)
    logs.set_up("vramctl hooks", "info", "human", "%(message)s")
    try:
        await act(hook, delivery, endpoint)
    except ActionFailed as error:
        print(f"vramctl: {printable(str(error))}", file=sys.stderr)
        return NO
    print(f"{rule}: done")
    return OK


async def serve(config: HooksConfig, endpoint: str, state: StateFile) -> int:
    """Deliver events until SIGTERM or SIGINT. Return the exit code."""
    saved = state.load()
    cursor = Cursor(saved.read)
    runner = Runner(config.hooks, lambda hook, one: act(hook, one, endpoint), pending=saved.pending)

    def present() -> Saved:
        return Saved(dict(cursor.read), runner.pending)

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    tasks = [
        asyncio.create_task(work)
        for work in (
            _read(endpoint, cursor, runner),
            runner.run(),
            runner.keep(state.save, present),
        )
    ]
    stopped = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait((*tasks, stopped), return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (stopped, *tasks):
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
        state.save(present())
    for error in ended:
        if isinstance(error, Exception):
            raise error
    for name, line in runner.lines.items():
        log.info("%s: %s", name, line.counts)
    return OK


async def _read(endpoint: str, cursor: Cursor, runner: Runner) -> None:
    """Queue new events. Waits for an arbiter that is not there.

    Tells systemd that the unit has started once no later event can be missed, or while it waits.
    """
    manager = Notifier(os.environ)
    client = AsyncClient(
        "vramctl hooks", endpoint=endpoint, role="observer", connect_timeout_s=RETRY_S
    )
    said = False
    while True:
        try:
            await client.__aenter__()
            break
        except ArbiterUnreachable as error:
            if not said:
                log.warning("waiting for an arbiter: %s", error)
                manager.ready("waiting for an arbiter")
            said = True
            await asyncio.sleep(RETRY_S)
    started = False
    try:
        async with aclosing(follow(client, cursor)) as batches:
            async for events in batches:
                runner.put(events, cursor.numbering)
                if not started and cursor.numbering:
                    started = True
                    log.info("delivers events of the arbiter at %s", client.endpoint)
                    manager.ready(f"delivers events of {client.endpoint}")
    finally:
        await client.__aexit__(None, None, None)
