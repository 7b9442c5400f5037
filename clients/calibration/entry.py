"""Entries of a footprint file (`configs/models/footprints.yaml`): their figures, and how they are
written without disturbing what a person wrote there."""

import json
import re
from collections.abc import Mapping
from pathlib import Path

from vram_arbiter.clients.calibration.record import Figures
from vram_arbiter.clients.cli import files
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import parse_yaml, read_text

MARGIN = 0.02
MARGIN_MAX_BYTES = 48 * MIB
"""Below the tolerance of a verification (64 MiB): a load that takes what was measured shows no
drift from what was declared."""
_PLAIN = re.compile(r"[A-Za-z0-9][\w./+-]*")
"""Texts that mean themselves in YAML; all others are quoted."""

type Entry = Mapping[str, str]


def entry_of(figures: Figures, source: str) -> Entry:
    """Return the fields of a footprint. `residue` is the context, which no unload gives back."""
    steady = with_margin(figures.steady)
    entry = {
        "load_peak": _size(max(with_margin(figures.load_peak), steady)),
        "steady": _size(steady),
        "residue": _size(min(figures.context, steady)),
    }
    if figures.inference_peak is not None:
        entry["inference_peak"] = _size(max(with_margin(figures.inference_peak), steady))
    return {**entry, "source": source}


def with_margin(count: int) -> int:
    """Return a measured size with the margin, in whole MiB."""
    return -(-(count + min(round(count * MARGIN), MARGIN_MAX_BYTES)) // MIB) * MIB


def text_of(key: str, entry: Entry) -> str:
    """Return an entry as YAML."""
    fields = "".join(f"  {name}: {_scalar(value)}\n" for name, value in entry.items())
    return f"{_scalar(key)}:\n{fields}"


def write(path: Path, key: str, entry: Entry) -> None:
    """Write an entry, or its fields into the one there. Everything else stays as it is.

    Raises ConfigError: the file is not a footprint file, or not written in lines of their own, or
    the entry stands for another model.
    """
    after = merged(path, key, entry)
    files.replace(path, after, path.stat().st_mode & 0o777 if path.exists() else 0o644)


def merged(path: Path, key: str, entry: Entry) -> str:
    """Return the text of a footprint file with this entry. Raises ConfigError."""
    text = read_text(path) if path.exists() else ""
    document = parse_yaml(text, str(path)).data
    if not isinstance(document, dict):
        raise ConfigError(
            f"{path}: must be a map from models to footprints",
            hint="write OWNER/NAME: {load_peak: 5.3GB, steady: 5.3GB}",
        )
    ended = text if not text or text.endswith("\n") else f"{text}\n"
    after = f"{ended}\n{text_of(key, entry)}".lstrip("\n")
    if key in document:
        after = _updated(ended, key, entry)
    there = document.get(key)
    old = there if isinstance(there, dict) else {}
    if parse_yaml(after, str(path)).data != {**document, key: {**old, **entry}}:
        raise ConfigError(  # anchors, a flow map, quotes
            f"{path}: {key} cannot be changed in place",
            hint="write its fields on lines of their own, without anchors",
        )
    return after


def _updated(text: str, key: str, entry: Entry) -> str:
    """Put each value where the old one stands; new fields follow the last one."""
    block = re.search(
        rf"^(['\"]?){re.escape(key)}\1:[^\n]*\n((?:[ \t]+\S.*\n)+)", text, re.MULTILINE
    )
    if block is None:
        return text
    body = block[2]
    indent = body[: len(body) - len(body.lstrip())]
    for name, value in entry.items():
        line = re.compile(rf"^({indent}{name}:[ \t]*)[^#\n]*?([ \t]*(?:#.*)?)$", re.MULTILINE)
        found = line.search(body)
        if found is None:
            body += f"{indent}{name}: {_scalar(value)}\n"
        else:
            fresh = f"{found[1]}{_scalar(value)}{found[2]}"
            body = body[: found.start()] + fresh + body[found.end() :]
    return text[: block.start(2)] + body + text[block.end(2) :]


def _size(count: int) -> str:
    return f"{-(-count // MIB)}MiB"


def _scalar(value: str) -> str:
    """Return a text as YAML, plain where that means the same."""
    return value if _PLAIN.fullmatch(value) else json.dumps(value, ensure_ascii=False)
