"""Hot reload of the configuration on SIGHUP: the file is read again and taken whole, or refused.

Keys in `LIVE_KEYS` take effect; changes of others are named and left for the next start. A refused
file changes nothing, and is a problem in `status` until a later reload succeeds. Constants of the
engine reach it as an event, so that a replay of the event log sees them. Must not decide anything
about leases.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vram_arbiter.arbiter.core.events import SettingsChanged
from vram_arbiter.arbiter.host.history import History
from vram_arbiter.arbiter.inbox import Inbox
from vram_arbiter.arbiter.settings import core_changes
from vram_arbiter.schemas.config.arbiter import LIVE_KEYS, ArbiterConfig
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.systemd import Notifier
from vram_arbiter.schemas.runtime.threads import answered_within

READ_S = 10.0
"""Time limit of reading the file, which may be on a disk that hangs."""
SETTLE_S = 0.05
"""A file that was not touched for so long is not being written."""
SETTLE_TRIES = 40
PROBLEM_CHARS = 1000


@dataclass(frozen=True, slots=True)
class Source:
    """Where the configuration comes from."""

    find: Callable[[], Path | None]
    """The file; None: there is none, and flags and defaults are the configuration."""
    load: Callable[[Path | None], ArbiterConfig]
    """Read a file, with the flags over it. Raises ConfigError."""


class Reload:
    """`ask` from a signal handler, `serve` as a task of the daemon."""

    def __init__(
        self,
        config: ArbiterConfig,
        source: Source,
        inbox: Inbox,
        history: History,
        say: Callable[[str, JsonMap], None],
    ) -> None:
        self._config = config
        self._source = source
        self._file = source.find()
        self._inbox = inbox
        self._history = history
        self._say = say
        self._asked = asyncio.Event()
        self.problem = ""
        self.pending = ""

    def ask(self) -> None:
        """Reload soon. Signals that come while a reload is under way cause one more."""
        self._asked.set()

    async def serve(self, notifier: Notifier, status: Callable[[], str]) -> None:
        """Reload whenever it is asked for, and tell the service manager."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            notifier.reloading()
            try:
                read = partial(_read, self._source, self._file)
                file, config = await answered_within(READ_S, read, "the configuration file")
            except VramError as error:
                self._refuse(error)
            else:
                self._file = file
                self._take(config)
            notifier.ready(status())

    def _refuse(self, error: VramError) -> None:
        said = _without_quotes(error)[:PROBLEM_CHARS]
        self.problem = f"the changed configuration is refused, the former one is in force: {said}"
        file = {} if self._file is None else {"file": str(self._file)}
        self._say("config_refused", {**file, "problem": said})

    def _take(self, config: ArbiterConfig) -> None:
        """Apply what can be applied, and say what was not."""
        changed, left = changes(self._config, config)
        self._config = merged(self._config, config)
        if constants := core_changes(self._config, changed):
            self._inbox.post(SettingsChanged(constants))
        self._history.keep(self._config.history.max_events, self._config.history.days)
        logging.getLogger().setLevel(self._config.log.level.upper())
        self.problem = ""
        self.pending = f"changed keys need a restart: {', '.join(left)}" if left else ""
        file = {} if self._file is None else {"file": str(self._file)}
        self._say("config_reloaded", {**file, "changed": changed, "needs_restart": left})


def _without_quotes(error: VramError) -> str:
    """What is wrong with the file, for every reader of `status`: without its text, which may be
    another file's behind a link."""
    mistakes: list[JsonMap] = error.details.get("fields", [])
    if not mistakes:
        return error.message
    file = error.details["file"]
    lines = ", ".join(str(line) for line in sorted({one["line"] for one in mistakes}) if line)
    return f"{file}:{lines or '1'}: see `vram-arbiter --check-config --config {file}`"


def changes(
    before: ArbiterConfig, after: ArbiterConfig
) -> tuple[dict[str, tuple[Any, Any]], dict[str, tuple[Any, Any]]]:
    """Return old and new values by `section.key`: of the keys that a reload applies, and of those
    that need a restart."""
    live: dict[str, tuple[Any, Any]] = {}
    others: dict[str, tuple[Any, Any]] = {}
    for section, keys in before.model_dump().items():
        now = after.model_dump()[section]
        for key, old in keys.items():
            if now[key] != old:
                found = live if key in LIVE_KEYS.get(section, ()) else others
                found[f"{section}.{key}"] = old, now[key]
    return live, others


def merged(before: ArbiterConfig, after: ArbiterConfig) -> ArbiterConfig:
    """Return `before` with the live keys of `after`."""
    sections = {
        section: getattr(before, section).model_copy(
            update={key: getattr(getattr(after, section), key) for key in keys}
        )
        for section, keys in LIVE_KEYS.items()
    }
    return before.model_copy(update=sections)


def _read(source: Source, earlier: Path | None) -> tuple[Path | None, ArbiterConfig]:
    """Read the file as it is once nothing writes it. Raises ConfigError."""
    path = source.find()
    if path is None:
        if earlier is not None:
            hint = "write `{}` for the defaults, or restart without the file"
            raise ConfigError(f"{earlier} is gone", hint=hint)
        return None, source.load(None)
    seen = None
    for _ in range(SETTLE_TRIES):
        before, seen = seen, _signature(path)
        if seen == before:
            break
        time.sleep(SETTLE_S)
    else:
        raise ConfigError(f"{path} is still being written", hint="reload when it is complete")
    if seen is not None and not seen[-1]:
        raise ConfigError(f"{path} is empty", hint="write `{}` for the defaults")
    config = source.load(path)
    if _signature(path) != seen:
        raise ConfigError(f"{path} changed while it was read", hint="reload once more")
    return path, config


def _signature(path: Path) -> tuple[int, int, int] | None:
    """Return inode, time of the last change and size; None: no such file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
