"""Entries of a footprint file (`configs/models/footprints.yaml`): their figures, and how they are
written without disturbing what a person wrote there."""

import json
import os
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path

from vram_arbiter.clients.calibration.series import MIB, Figures
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import (
    block_map,
    parse_yaml,
    read_text,
    reads_as_text,
    top_keys,
)

MARGIN = 0.02
MARGIN_MAX_BYTES = 48 * MIB
"""Below the tolerance of a verification (64 MiB): a load that takes what was measured shows no
drift from what was declared."""
_PLAIN = re.compile(r"[A-Za-z0-9][\w ./+@(),%-]*")
"""Texts that mean themselves in YAML; all others are quoted."""

type Entry = Mapping[str, str]


def entry_of(figures: Figures, source: str) -> Entry:
    """Return the fields of a footprint. `residue` is the context, which no unload gives back."""
    steady = with_margin(figures.steady)
    entry = {
        "load_peak": _size(max(with_margin(figures.load_peak), steady)),
        "steady": _size(steady),
        "residue": _size(min(_whole(figures.context), steady)),
    }
    if figures.inference_peak is not None:
        entry["inference_peak"] = _size(max(with_margin(figures.inference_peak), steady))
    return {**entry, "source": source}


def with_margin(count: int) -> int:
    """Return a measured size with the margin, in whole MiB."""
    return _whole(count + min(round(count * MARGIN), MARGIN_MAX_BYTES))


def text_of(key: str, entry: Entry) -> str:
    """Return an entry as YAML."""
    fields = "".join(f"  {name}: {_scalar(value)}\n" for name, value in entry.items())
    return f"{_scalar(key)}:\n{fields}"


def write(path: Path, key: str, entry: Entry) -> None:
    """Write an entry, or its fields into the one there. Everything else stays as it is.

    Raises ConfigError: the file is not a footprint file, or not written in lines of their own.
    """
    before = read_text(path) if path.exists() else ""
    after = merged(before, str(path), key, entry)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(after)
        os.chmod(temporary, path.stat().st_mode & 0o777 if path.exists() else 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def merged(text: str, name: str, key: str, entry: Entry) -> str:
    """Return the text of a footprint file with this entry. Raises ConfigError."""
    document = parse_yaml(text, name).data
    if not isinstance(document, dict):
        raise ConfigError(
            f"{name}: must be a map from models to footprints",
            hint="write OWNER/NAME: {load_peak: 5.3GB, steady: 5.3GB}",
        )
    if key not in top_keys(text):
        ended = text if not text or text.endswith("\n") else f"{text}\n"
        after = f"{ended}\n{text_of(key, entry)}" if ended else text_of(key, entry)
    else:
        after = _updated(text, name, key, entry)
    expected = {**document, key: {**(document.get(key) or {}), **entry}}
    if parse_yaml(after, name).data != expected:  # anchors, or an indentation of its own
        raise ConfigError(
            f"{name}: {key} cannot be changed in place",
            hint="write its fields on lines of their own, without anchors",
        )
    return after


def _updated(text: str, name: str, key: str, entry: Entry) -> str:
    """Put each value where the old one stands; new fields follow the last one."""
    block = block_map(text, key)
    if block is None:
        raise ConfigError(
            f"{name}: {key} cannot be changed in place",
            hint="write its fields on lines of their own",
        )
    spans = block.values
    last = max(end for _, end in spans.values())
    line_end = text.find("\n", last)
    line_end = len(text) if line_end < 0 else line_end
    indent = " " * block.column
    added = [
        f"\n{indent}{field}: {_scalar(value)}"
        for field, value in entry.items()
        if field not in spans
    ]
    edits = [(line_end, line_end, "".join(added))]
    edits += [(*spans[field], _scalar(value)) for field, value in entry.items() if field in spans]
    for start, end, fresh in sorted(edits, reverse=True):
        text = text[:start] + fresh + text[end:]
    return text


def _whole(count: int) -> int:
    return -(-count // MIB) * MIB


def _size(count: int) -> str:
    return f"{count // MIB}MiB"


def _scalar(value: str) -> str:
    """Return a text as YAML, plain where that means the same."""
    if _PLAIN.fullmatch(value) and not value.endswith(" ") and reads_as_text(value):
        return value
    return json.dumps(value, ensure_ascii=False)
