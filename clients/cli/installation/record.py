"""What an installation put on the machine: files with their digests, links, folders, users.

`uninstall` removes what is recorded and unchanged, and nothing else.
"""

import hashlib
import os
import stat
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from vram_arbiter.clients.cli.installation.environment import writable_by_others
from vram_arbiter.clients.cli.installation.site import GROUP, Site
from vram_arbiter.schemas.errors import ConfigError


class Record(BaseModel):
    """The file `installed.json`."""

    model_config = ConfigDict(extra="forbid", validate_assignment=True)

    version: str = ""
    prefix: Path = Path("/")
    group: str = GROUP
    files: dict[Path, str] = {}
    """Path → SHA-256 of what was written, not of what is there now."""
    links: dict[Path, str] = {}
    folders: list[Path] = []
    """Made for a file; removed if they are empty."""
    users: list[str] = []
    groups: list[str] = []
    memberships: list[tuple[str, str]] = []
    """(user, group), given by --operators."""
    enabled: list[str] = []
    """Units that an installation enabled and started once."""


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def load(site: Site) -> Record | None:
    """Return the record of the last installation, None without one.

    Raises ConfigError for a file that this version did not write, or that another user could have.
    """
    path = site.at(site.record)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    with open(fd, "rb") as file:
        found = os.fstat(fd)
        if not stat.S_ISREG(found.st_mode):
            raise ConfigError(f"{path} is not a file")
        if os.getuid() == 0 and (problem := writable_by_others(found)):
            raise ConfigError(f"{path} {problem}; it says what root removes", hint="check it")
        try:
            return Record.model_validate_json(file.read())
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]["msg"]
            raise ConfigError(
                f"{path} is not the record of an installation: {problem}",
                hint="move it away; the next installation takes over the files that are as it "
                "would write them",
            ) from error
