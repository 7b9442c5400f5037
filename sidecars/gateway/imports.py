"""`vram-gateway import`: llama-swap's configuration → the gateway's.

Macros are expanded as llama-swap's `internal/config/macros.go` does it: environment first, then the
last declared macro first. Whatever has no counterpart is named, never dropped in silence.
"""

import argparse
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import yaml

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.config.gateway import PARALLEL_MAX, PRIORITY, load_gateway
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.units import parse_bytes
from vram_arbiter.schemas.urls import http_url
from vram_arbiter.schemas.yamltext import YamlText, read_yaml

COMPLETE, INCOMPLETE = 0, 1
ABOVE: Final = d.PRIORITY - 1
"""Highest priority that is given: a robot's models stay above."""
KEEP_ALIVE_S: Final = 10.0
_HEADER: Final = "# Written by `vram-gateway import` from {}.\n"
_NO_CHECK: Final = "none"
FREE: Final = "1"
"""Stands for a free port in a URL."""
_ENV = re.compile(r"\$\{env\.([A-Za-z_][A-Za-z0-9_]*)\}")
_MACRO = re.compile(r"\$\{([A-Za-z0-9_-]+)\}")
_AS_IT_IS = "a body is passed on as it is"
_WHY: Final[Mapping[str, str]] = {
    "apiKeys": "secrets are not copied; write them into a file of mode 0600, named by `keys_file`",
    "cmdStop": "the process is ended by SIGTERM",
    "evict_costs": "the arbiter measures what a return costs",
    "filters": _AS_IT_IS,
    "hooks": "a server starts with its first request",
    "peers": "they are not on this machine's GPUs",
    "unlisted": "/v1/models lists every server",
    "unloadTimeout": "`grace_s` bounds requests in flight and the end of the process, 300 s",
    "useModelName": f"{_AS_IT_IS}; start the server under the names that clients ask for",
}
"""Why a key has no counterpart, where that is not plain."""
_SETTINGS = ("globalTTL", "healthCheckTimeout", "macros", "models", "sendLoadingState", "startPort")
_ROUTING = ("groups", "matrix", "routing")
_OF_MODEL = (
    "aliases", "checkEndpoint", "cmd", "concurrencyLimit", "env", "macros", "proxy", "ttl",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Converted:
    """The gateway's file. `left`: what has no counterpart; `noted`: what is there in another way.
    Both name the key first."""

    text: str
    left: Sequence[str]
    noted: Sequence[str]


@dataclass(slots=True)
class _Reader:
    """One conversion. `macros`: the file's own. `sizes`: `vram` by model, "" for all others."""

    sizes: Mapping[str, str]
    macros: JsonMap
    defaults: dict[str, Any]
    left: list[str] = field(default_factory=list)
    noted: list[str] = field(default_factory=list)

    def leave(self, keys: JsonMap, known: Sequence[str], path: str = "") -> None:
        """Name the keys that are not in `known`."""
        for key in keys:
            if key not in known:
                self.left.append(f"{path}{key}: {_WHY.get(key, 'no counterpart')}")

    def server(self, model: str, given: JsonMap) -> dict[str, Any] | None:
        """Return one server; None if it is left out as a whole. Raises ConfigError."""
        path = f"models.{model}."
        macros = (
            {"MODEL_ID": model} | dict(self.macros) | _map(given.get("macros"), f"{path}macros")
        )
        given = {
            key: _expanded(_without_comments(value) if key == "cmd" else value, macros)
            for key, value in given.items()
            if key != "macros"
        }
        self.leave(given, _OF_MODEL, path)
        command = _command(str(given.get("cmd") or ""), path)
        proxy = str(given.get("proxy") or "http://localhost:${PORT}").replace("${PORT}", FREE)
        try:
            url = urlsplit(http_url(proxy, "a URL such as http://localhost:9100"))
        except ValueError as error:
            raise ConfigError(f"{path}proxy: {error}") from error
        if not command or url.hostname not in ("localhost", "127.0.0.1"):
            self.left.append(f"models.{model}: not a program of this machine")
            return None
        if url.port == int(FREE) and not any("{port}" in argument for argument in command):
            self.left.append(f"models.{model}: neither `cmd` nor `proxy` say where it listens")
            return None
        if Path(command[0]).name in ("docker", "podman"):
            self.left.append(f"{path}cmd: the bytes of a container count as a stowaway's")
        if url.path.strip("/") or url.scheme != "http":
            self.left.append(f"{path}proxy: only the port of {given['proxy']!r} is taken")
        made = self.defaults | {"command": command, "models": [model, *_list(given, "aliases")]}
        if url.port != int(FREE):
            made["port"] = url.port or 80
        made |= self._optional(given, path)
        if size := self.sizes.get(model, self.sizes.get("")):
            made["vram"] = size
        else:
            self.left.append(f"{path}vram: not known; measure it with `vramctl calibrate`, --vram")
        return made

    def _optional(self, given: JsonMap, path: str) -> dict[str, Any]:
        made: dict[str, Any] = {}
        if variables := _list(given, "env"):
            pairs = (str(one).replace("${PORT}", "{port}").partition("=") for one in variables)
            made["env"] = {name: value for name, _, value in pairs}
        if (ttl := _number(given, "ttl", -1)) >= 0:
            made["idle_s"] = ttl or None  # 0: never, whatever `globalTTL` says
        if limit := _number(given, "concurrencyLimit"):
            made["parallel"] = min(limit, PARALLEL_MAX)
        if (health := given.get("checkEndpoint", "")) == _NO_CHECK:
            self.left.append(f"{path}checkEndpoint: a server is awake once `health` answers 200")
        elif health:
            made["health"] = health
        return made

    def priorities(self, data: JsonMap) -> dict[str, int]:
        """Return priorities of leases by model; say what replaces groups and matrix."""
        routing = _map(data.get("routing"), "routing")
        router, scheduler = (_map(routing.get(key), key) for key in ("router", "scheduler"))
        rules = _map(router.get("settings"), "settings") | dict(data)
        self.leave(_map(rules.get("matrix"), "matrix"), ("vars", "sets"), "matrix.")
        groups = _map(rules.get("groups"), "groups")
        if groups or rules.get("matrix"):
            self.noted.append("groups, matrix: servers that fit stay beside each other, measured")
        found: dict[str, int] = {}
        for name, group in groups.items():
            if _map(group, f"groups.{name}").get("persistent"):
                found |= dict.fromkeys(_list(group, "members"), ABOVE)
                self.noted.append(f"groups.{name}.persistent: priority {ABOVE} of its members")
        fifo = _map(_map(scheduler.get("settings"), "settings").get("fifo"), "fifo")
        wanted = _map(fifo.get("priority"), "priority")
        for model in wanted:
            found[model] = max(0, min(PRIORITY + _number(wanted, model), ABOVE))
            self.noted.append(f"fifo.priority.{model}: priority {found[model]} of its lease")
        return found


def convert(
    source: YamlText, sizes: Mapping[str, str], environ: Mapping[str, str], listen: str = ""
) -> Converted:
    """Convert a configuration of llama-swap. `sizes`: `vram` by model, "" for all others.

    Raises ConfigError: the file is wrong, or nothing in it can be converted.
    """
    data = _map(_each(source.data, lambda text: _with_environ(text, environ)), source.name)
    macros = _map(data.get("macros"), "macros")
    data = {
        key: value if key == "models" else _expanded(value, macros) for key, value in data.items()
    }
    defaults = {"idle_s": data.get("globalTTL") or None, "start_s": data.get("healthCheckTimeout")}
    reader = _Reader(sizes, macros, {key: value for key, value in defaults.items() if value})
    reader.leave(data, (*_SETTINGS, *_ROUTING))
    priorities, servers = reader.priorities(data), dict[str, Any]()
    for model, given in _map(data.get("models"), "models").items():
        made = reader.server(model, _map(given, f"models.{model}"))
        if made is not None:
            name = re.sub(r"[^A-Za-z0-9._-]", "-", model).lstrip("._-")[:64] or "model"
            if model in priorities:
                made["priority"] = priorities[model]
            made["models"] = [one for one in made["models"] if one != name]
            servers[name] = {key: value for key, value in made.items() if value not in (None, [])}
    head: dict[str, Any] = {"listen": listen} if listen else {}
    if data.get("sendLoadingState"):
        head["keep_alive_s"] = KEEP_ALIVE_S
    text = yaml.safe_dump(head | {"servers": servers}, sort_keys=False, width=100)
    load_gateway(text, f"{source.name}, converted")
    return Converted(_HEADER.format(Path(source.name).name) + text, reader.left, reader.noted)


# -- values
def _expanded(value: Any, macros: JsonMap) -> Any:
    def expand(text: str) -> Any:
        for name, content in reversed(list(macros.items())):
            if text == f"${{{name}}}" and not isinstance(content, str):
                return content
            said = str(content).lower() if isinstance(content, bool) else str(content)
            text = text.replace(f"${{{name}}}", said)
        return text

    return _each(value, expand)


def _each(value: Any, change: Callable[[str], Any]) -> Any:
    """Return a value with each of its texts changed; keys stay."""
    if isinstance(value, dict):
        return {key: _each(inner, change) for key, inner in value.items()}
    if isinstance(value, list):
        return [_each(inner, change) for inner in value]
    return change(value) if isinstance(value, str) else value


def _with_environ(text: str, environ: Mapping[str, str]) -> str:
    """Raises ConfigError for a variable that is not set."""
    for name in _ENV.findall(text):
        if name not in environ:
            raise ConfigError(
                f"the environment variable {name} is not set", hint="set it, as for llama-swap"
            )
    return _ENV.sub(lambda found: environ[found[1]], text)


def _without_comments(text: str) -> str:
    """Before macros are expanded: a macro in a comment is not to become an argument."""
    return "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))


def _command(text: str, path: str) -> list[str]:
    """Raises ConfigError for quotes that do not end, and for macros that are not declared."""
    lines = (line.strip().removesuffix("\\") for line in _without_comments(text).splitlines())
    text = " ".join(lines).replace("${PORT}", "{port}")
    if unknown := _MACRO.search(text):
        raise ConfigError(f"{path}cmd: unknown macro {unknown[0]}")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"{path}cmd: {error}") from error


def _map(value: Any, name: str) -> dict[str, Any]:
    """Raises ConfigError."""
    if not isinstance(value or {}, dict):
        raise ConfigError(f"{name}: expected a map, got {value!r}")
    return dict(value or {})


def _list(given: JsonMap, key: str) -> list[Any]:
    """Raises ConfigError."""
    if not isinstance(given.get(key) or [], list):
        raise ConfigError(f"{key}: expected a list, got {given[key]!r}")
    return list(given.get(key) or [])


def _number(given: JsonMap, key: str, otherwise: int = 0) -> int:
    """Raises ConfigError."""
    value = given.get(key, otherwise)
    if not isinstance(value, int):
        raise ConfigError(f"{key}: expected a number, got {value!r}")
    return value


# -- command line
def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("file", type=Path, help="llama-swap's configuration")
    add("--out", type=Path, metavar="FILE", help="a new file instead of stdout")
    add("--listen", default="", metavar="ADDRESS:PORT", help="default: that of the gateway")
    add(
        "--vram", action="append", default=[], type=_size, metavar="[MODEL=]SIZE",
        help="bytes of one model's server, or of all others; may be repeated",
    )  # fmt: skip


def _size(text: str) -> tuple[str, str]:
    model, _, size = text.rpartition("=")
    try:
        parse_bytes(size)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return model, size


def run(args: argparse.Namespace) -> int:
    """Return 1 if anything has no counterpart. Raises ConfigError."""
    converted = convert(read_yaml(args.file), dict(args.vram), os.environ, args.listen)
    for note in converted.noted:
        print(printable(f"note: {note}"), file=sys.stderr)
    for note in converted.left:
        print(printable(f"not converted: {note}"), file=sys.stderr)
    if args.out is None:
        print(converted.text, end="")
        return INCOMPLETE if converted.left else COMPLETE
    try:
        with args.out.open("x", encoding="utf-8") as file:
            file.write(converted.text)
    except FileExistsError as error:
        raise ConfigError(f"{args.out} exists", hint="name a new file with --out") from error
    return INCOMPLETE if converted.left else COMPLETE
