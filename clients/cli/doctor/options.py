"""How the daemon was told to run: its command line and its configuration file."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.yamltext import parse_yaml

CONFIG: Final = "/etc/vram-arbiter/arbiter.yaml"


@dataclass(frozen=True, slots=True)
class Options:
    """`words`: the daemon's command line; `path`: its file, "" for none; `sections`: of the file.

    A value of the command line wins over one of the file.
    """

    words: Sequence[str]
    path: str
    sections: JsonMap

    def flag(self, name: str) -> str:
        return flag(self.words, name)

    def key(self, section: str, key: str) -> str:
        part = self.sections.get(section)
        value = part.get(key) if isinstance(part, dict) else None
        return "" if value is None else str(value)


def options_of(m: Machine) -> Options:
    """Return the options of the daemon that answers, else those that it would start with. Raises
    CouldNotLook."""
    words = m.command_line(m.arbiter.pid) if m.arbiter.pid else []
    path = flag(words, "--config") or (CONFIG if m.is_system else "")
    text = m.text(path) if path else None
    if text is None:
        return Options(words, "", {})
    try:
        data = parse_yaml(text, path).data
    except ConfigError as error:
        raise CouldNotLook(error.message) from error
    return Options(words, path, data if isinstance(data, dict) else {})


def flag(words: Sequence[str], name: str) -> str:
    """Return the value of a flag, "" where it is not given."""
    for at, word in enumerate(words):
        if word == name and at + 1 < len(words):
            return words[at + 1]
        if word.startswith(f"{name}="):
            return word.partition("=")[2]
    return ""
