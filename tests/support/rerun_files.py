"""Rerun files, as far as tests look into them."""

from pathlib import Path


def rows_of(path: Path) -> dict[str, int]:
    """Rows by entity of a Rerun file."""
    from rerun.experimental import RrdReader

    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).store().stream().to_chunks():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows
