"""Entries of a footprint file (`configs/models/footprints.yaml`) from measured figures."""

import yaml

from vram_arbiter.clients.calibration.record import Figures
from vram_arbiter.schemas.defaults import MIB, RESIDUE_BYTES

MARGIN = 0.02
MARGIN_MAX_BYTES = 48 * MIB
"""Below the tolerance of a verification (64 MiB): a load that takes what was measured shows no
drift from what was declared."""

type Entry = dict[str, str]


def entry_of(figures: Figures, source: str) -> Entry:
    """Return the fields of a footprint. `residue` is a usual context, which no unload gives
    back."""
    steady = with_margin(figures.steady)
    entry = {
        "load_peak": _size(max(with_margin(figures.load_peak), steady)),
        "steady": _size(steady),
        "residue": _size(min(RESIDUE_BYTES, steady)),
    }
    if figures.inference_peak is not None:
        entry["inference_peak"] = _size(max(with_margin(figures.inference_peak), steady))
    return {**entry, "source": source}


def with_margin(count: int) -> int:
    """Return a measured size with the margin, in whole MiB."""
    return -(-(count + min(round(count * MARGIN), MARGIN_MAX_BYTES)) // MIB) * MIB


def text_of(key: str, entry: Entry) -> str:
    """Return an entry as YAML."""
    return yaml.safe_dump({key: entry}, sort_keys=False, width=1000)


def _size(count: int) -> str:
    return f"{-(-count // MIB)}MiB"
