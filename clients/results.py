"""Results of numbered work, each committed once.

Programs that die and begin again may do a piece of work twice, but its result counts once: the
first `commit` of a seed wins, by a link that the file system makes once.
"""

import json
import os
import tempfile
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap


def commit(folder: Path, seed: int, result: JsonMap) -> bool:
    """Write the seed's result to `folder`/00007.json, durably; False if it has one already.

    Raises OSError, and ValueError for a result that JSON cannot say.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result, allow_nan=False)
    fd, beside = tempfile.mkstemp(prefix=f".{seed}.", dir=folder)
    try:
        with open(fd, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.link(beside, folder / f"{seed:05d}.json")
    except FileExistsError:
        return False
    finally:
        os.unlink(beside)
    _sync(folder)
    return True


def committed(folder: Path) -> dict[int, JsonMap]:
    """Results by seed, in the order of seeds. Raises ConfigError for a file that is not one."""
    found: dict[int, JsonMap] = {}
    for path in folder.glob("[0-9]*.json"):
        try:
            found[int(path.stem)] = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{path} is not a result: {error}", hint="remove it, and its seed is played again"
            ) from None
    return dict(sorted(found.items()))


def _sync(folder: Path) -> None:
    """Let the link itself outlive a power cut."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
