"""Where an installation goes: this machine, one user's home, or a folder for another machine.

Paths of the other modules are those of the installed machine; only `Site.at` knows the folder.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError

ARBITER = "vram-arbiter.service"
PROGRAMS = (
    "vram-arbiter", "vramctl", "vram-observer", "vram-sidecar", "vram-runner", "vram-reasoner",
    "vram-gateway",
)  # fmt: skip
LINK = "-> "
"""Begins the text of a link; its target follows."""


@dataclass(frozen=True, slots=True)
class Site:
    """Folders of one installation. `root` other than `/`: files alone, for another machine or an
    image."""

    units: Path
    settings: Path
    programs: Path
    shared: Path
    """Of the shell completions."""
    state: tuple[Path, ...]
    """In these each program has a folder of its name: journals, caches, sockets."""
    system: bool
    root: Path = Path("/")

    def at(self, path: Path) -> Path:
        """Return where a path of the installed machine is on this one. The last name is not
        followed. Raises ConfigError for a link on the way that leads out of the folder: this
        machine's kernel follows it."""
        place = self.root / path.relative_to("/")
        if place == self.root:
            return place
        folder = place.parent.resolve()
        if not folder.is_relative_to(self.root.resolve()):
            raise ConfigError(
                f"{place.parent} leads to {folder}, out of {self.root}",
                hint="make the link a relative one, or mount the image and install inside it",
            )
        return folder / place.name

    def folder(self, path: Path) -> Path:
        """Return where a folder of the installed machine is on this one, also through a link."""
        return self.at(path / "_").parent

    def read(self, path: Path) -> str | None:
        """Return the text of a file, or of a link; None for nothing, empty for anything else."""
        place = self.at(path)
        if place.is_symlink():
            return f"{LINK}{os.readlink(place)}"
        if place.is_file():
            return place.read_text(encoding="utf-8", errors="surrogateescape")
        return "" if place.exists() else None

    def trees(self) -> list[Path]:
        """Return the folders that a purge removes whole."""
        return [folder / name for folder in self.state for name in PROGRAMS] + [self.settings]

    @property
    def live(self) -> bool:
        """Whether the services of this machine are meant."""
        return self.root == Path("/")

    @property
    def record(self) -> Path:
        """The file that says what was installed."""
        return self.settings / "installed.json"


SYSTEM = Site(
    units=Path("/etc/systemd/system"),
    settings=Path("/etc/vram-arbiter"),
    programs=Path("/usr/local/bin"),
    shared=Path("/usr/local/share"),
    # the folder `private` has those of units without a user of their own
    state=tuple(map(Path, ("/var/lib", "/var/lib/private", "/var/cache", "/run"))),
    system=True,
)


def site_of_user(environ: Mapping[str, str]) -> Site:
    """Return the folders of the calling user (XDG base directories)."""

    def folder(variable: str, otherwise: str) -> Path:
        value = environ.get(variable, "")
        return Path(value) if value.startswith("/") else Path.home() / otherwise

    settings = folder("XDG_CONFIG_HOME", ".config")
    runtime = Path(environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}")
    return Site(
        units=settings / "systemd/user",
        settings=settings / "vram-arbiter",
        programs=Path.home() / ".local/bin",
        shared=folder("XDG_DATA_HOME", ".local/share"),
        state=(folder("XDG_STATE_HOME", ".local/state"), runtime),
        system=False,
    )


def tegra_devices(site: Site) -> list[str]:
    """Return the device nodes of a Tegra's GPU that are there.

    They lie in folders of other names from one generation to the next (`/dev/nvgpu/igpu0` on Orin,
    `/dev/nvgpu/igpu-0000:01:00.0` on Thor), and a unit takes no pattern for a device node.
    """
    devices = site.folder(Path("/dev"))
    patterns = ("nvmap", "nvsciipc", "nvhost-*", "host1x-*", "nvgpu/*/*")
    found = {path for pattern in patterns for path in devices.glob(pattern) if not path.is_dir()}
    return sorted(str(Path("/dev") / path.relative_to(devices)) for path in found)
