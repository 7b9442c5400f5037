"""`vram-observer`: parse, check, run. Everything else is in `program`."""

import argparse
import asyncio
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import which
from typing import Final

from vram_arbiter.clients.cli import arguments
from vram_arbiter.schemas.config.observer import Hook, ObserverConfig, load_observer
from vram_arbiter.schemas.errors import ActionFailed, AlreadyRunning, ConfigError, VramError
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import add_version
from vram_arbiter.schemas.yamltext import check_owner, read_text

NAME: Final = "observer.yaml"
STATE: Final = "hooks.json"
PROGRAM: Final = "vram-observer"
EXIT_FAILED, EXIT_USAGE, EXIT_RUNNING = 1, 2, 3

_EPILOG = """\
exit codes:
  0   stopped by SIGTERM or SIGINT, or nothing wrong was found
  1   a hook failed (--test-hook), or the arbiter refuses an observer
  2   wrong flags or configuration, or the extra `observer` is not installed
  3   another observer delivers these hooks

environment:
  OTEL_EXPORTER_OTLP_ENDPOINT and the other standard OTEL_ variables send spans, metrics and log
  records to a collector (docs/reference/telemetry.md)
"""


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Shows an arbiter: status page and /metrics over HTTP, spans, metrics and logs "
        "over OTLP, hooks for events. Reads only, and touches no grant.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        help=f"YAML file with `http` and `hooks` (default: {NAME} in CONFIGURATION_DIRECTORY, "
        "~/.config/vram-arbiter or /etc/vram-arbiter, if there is one)",
    )
    made.add_argument(
        "--http", metavar="ADDRESS:PORT", help="wins over http.listen, e.g. 127.0.0.1:9870"
    )
    made.add_argument(
        "--state",
        metavar="FILE",
        type=Path,
        help=f"file of what hooks were delivered (default: {STATE} in STATE_DIRECTORY, else in "
        f"~/.local/state/{PROGRAM})",
    )
    made.add_argument(
        "--check", action="store_true", help="check the configuration, say what would run, and exit"
    )
    made.add_argument("--test-hook", metavar="RULE", help="fire one rule with a sample event")
    made.add_argument("--on", metavar="EVENT", help="for --test-hook: one of its events")
    made.add_argument("--ends-with", metavar="PID", type=int, help="end when this process ends")
    made.add_argument("--log-format", choices=logs.FORMS, default="human")
    arguments.add_endpoint(made)
    add_version(made)
    return made


def find_config(environ: Mapping[str, str]) -> Path | None:
    """Return the configuration file, if there is one."""
    home = environ.get("XDG_CONFIG_HOME") or f"{environ.get('HOME', '/')}/.config"
    folders = [f"{home}/vram-arbiter", "/etc/vram-arbiter"]
    if under_systemd := environ.get("CONFIGURATION_DIRECTORY"):
        folders.insert(0, under_systemd.split(":")[0])
    places = (Path(folder, NAME) for folder in folders)
    return next((place for place in places if place.exists()), None)


def state_path(environ: Mapping[str, str]) -> Path:
    if under_systemd := environ.get("STATE_DIRECTORY"):
        # systemd's own link for a user that exists only while the unit runs
        return Path(under_systemd.split(":")[0]).resolve() / STATE
    home = environ.get("XDG_STATE_HOME") or f"{environ.get('HOME', '/')}/.local/state"
    return Path(home, PROGRAM, STATE)


def read_config(path: Path | None, http: str | None) -> ObserverConfig:
    """Return the file's configuration with the flag over it, checked as far as possible without
    running it. Raises ConfigError."""
    config = ObserverConfig()
    if path is not None:
        text = read_text(path, hint="--config needs a readable YAML file", trusted=True)
        config = load_observer(text, str(path))
        if config.hooks:
            _check_hooks(config.hooks, path)
    if http is not None:
        values = config.model_dump()
        values["http"]["listen"] = http
        try:
            config = ObserverConfig.model_validate(values)
        except ValueError as error:
            raise ConfigError(f"--http: {error}", hint=f"see {PROGRAM} --help") from error
    return config


def _check_hooks(hooks: Sequence[Hook], path: Path) -> None:
    from httpx import URL, InvalidURL

    from vram_arbiter.clients.observer.hooks.actions import read_headers

    for hook in hooks:
        if hook.webhook is not None:
            try:
                URL(hook.webhook)
            except InvalidURL as error:
                raise ConfigError(f"{path}: {hook.name}: {error}", hint="see `webhook`") from error
        if hook.command is not None:
            _check_program(hook.command[0], f"{path}: {hook.name}")
        if hook.headers_file is not None:
            read_headers(hook.headers_file)


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


def plan(config: ObserverConfig) -> list[str]:
    """Return what would run, a line each."""
    lines = [f"status page and /metrics: {config.http.listen or 'none'}"]
    for hook in config.hooks:
        about = "" if hook.consumer == "*" else f" of {hook.consumer}"
        if hook.command is not None:
            does = f"runs {' '.join(map(repr, hook.command))}, at most {hook.timeout_s:g} s"
        else:
            headers = f" with the headers of {hook.headers_file}" if hook.headers_file else ""
            does = f"posts to {hook.webhook}{headers}, {hook.attempts} times at most"
        lines.append(printable(f"{hook.name}: on {', '.join(hook.on)}{about} {does}"))
    return lines


def fire(config: ObserverConfig, rule: str, on: str | None, endpoint: str) -> int:
    """Fire one rule with a sample event. Return the exit code. Raises ConfigError."""
    from vram_arbiter.clients.observer.hooks.actions import act
    from vram_arbiter.clients.observer.hooks.events import sample

    hook = next((one for one in config.hooks if one.name == rule), None)
    if hook is None:
        known = ", ".join(one.name for one in config.hooks) or "none"
        raise ConfigError(f"unknown hook {rule!r}", hint=f"hooks: {known}")
    if on is not None and on not in hook.on:
        raise ConfigError(f"{rule} is not for {on!r}", hint=f"events: {', '.join(hook.on)}")
    delivery = sample(hook, on or hook.on[0])
    print(delivery.body.decode(), flush=True)
    try:
        asyncio.run(act(hook, delivery, endpoint))
    except ActionFailed as error:
        print(f"{PROGRAM}: {printable(str(error))}", file=sys.stderr)
        return EXIT_FAILED
    print(f"{rule}: done")
    return 0


def _run(args: argparse.Namespace) -> int:
    endpoint = args.endpoint or arbiter_endpoint(os.environ, os.getuid())
    try:
        config = read_config(args.config or find_config(os.environ), args.http)
        if args.check:
            print("\n".join(plan(config)))
            return 0
        logs.set_up(PROGRAM, "info", args.log_format, f"{PROGRAM}: %(levelname)s %(message)s")
        if args.test_hook is not None:
            return fire(config, args.test_hook, args.on, endpoint)
        from vram_arbiter.clients.observer.program import Observer, Options
    except ImportError as error:
        raise ConfigError(
            f"the observer's packages are not installed: {error}",
            hint="pip install 'vram-arbiter[observer]'",
        ) from error
    logging.getLogger("httpx").setLevel(logging.WARNING)
    logging.getLogger("uvicorn").setLevel(logging.ERROR)  # it warns of every malformed request
    options = Options(config, endpoint, args.state or state_path(os.environ), args.ends_with)

    async def observe() -> None:
        await Observer(options).run()

    asyncio.run(observe())
    return 0


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code; prints errors of the operator as one line without a traceback."""
    args = parser().parse_args(argv)
    try:
        return _run(args)
    except VramError as error:
        terminal.complain(PROGRAM, error)
        match error:
            case ConfigError():
                return EXIT_USAGE
            case AlreadyRunning():
                return EXIT_RUNNING
            case _:
                return EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
