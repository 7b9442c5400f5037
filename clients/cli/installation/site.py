"""Where an installation goes: this machine, one user's home, or a folder for another machine.

Paths of the other modules are those of the installed machine; only `Site.at` knows the folder.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError

ARBITER = "vram-arbiter.service"
CLIENTS = (
    "vram-observer.service",
    "vram-sidecar@.service",
    "vram-runner@.service",
    "vram-reasoner@.service",
    "vram-reasoner.service",
)
OF_USER = (ARBITER, "vram-reasoner.service")
PROGRAMS = (
    "vram-arbiter",
    "vramctl",
    "vram-observer",
    "vram-sidecar",
    "vram-runner",
    "vram-reasoner",
)
GROUP = "vram-arbiter"
OPERATORS = "vram-operators"
LINK = "-> "
"""Begins the text of a link; its target follows."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Folders of one kind of installation."""

    units: Path
    settings: Path
    programs: Path
    shared: Path
    """Of the shell completions."""
    state: tuple[Path, ...]
    """What the programs write: journals, caches, sockets."""
    system: bool


SYSTEM = Layout(
    units=Path("/etc/systemd/system"),
    settings=Path("/etc/vram-arbiter"),
    programs=Path("/usr/local/bin"),
    shared=Path("/usr/local/share"),
    state=tuple(
        Path(folder)
        for folder in (
            *(f"/var/lib/vram-{name}" for name in ("arbiter", "runner", "reasoner", "observer")),
            "/var/lib/private/vram-observer",  # where that leads: its user exists while it runs
            "/var/cache/vram-sidecar",
            "/var/cache/vram-runner",
            "/run/vram-arbiter",
        )
    ),
    system=True,
)


def layout_of_user(environ: Mapping[str, str]) -> Layout:
    """Return the folders of the calling user (XDG base directories). Raises ConfigError."""
    home = Path(environ.get("HOME", ""))
    if not home.is_absolute():
        raise ConfigError("no home folder: HOME is not set", hint="set it, or log in")

    def folder(variable: str, otherwise: str) -> Path:
        value = environ.get(variable, "")
        return Path(value) if value.startswith("/") else home / otherwise

    settings = folder("XDG_CONFIG_HOME", ".config")
    kept = folder("XDG_STATE_HOME", ".local/state")
    state = [kept / "vram-arbiter", kept / "vram-observer"]
    if runtime := environ.get("XDG_RUNTIME_DIR"):
        state.append(Path(runtime) / "vram-arbiter")
    return Layout(
        units=settings / "systemd/user",
        settings=settings / "vram-arbiter",
        programs=home / ".local/bin",
        shared=folder("XDG_DATA_HOME", ".local/share"),
        state=tuple(state),
        system=False,
    )


@dataclass(frozen=True, slots=True)
class Site:
    """One installation. `root` other than `/`: files alone, for another machine or an image."""

    layout: Layout
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

    @property
    def live(self) -> bool:
        """Whether the services of this machine are meant."""
        return self.root == Path("/")

    @property
    def record(self) -> Path:
        """The file that says what was installed."""
        return self.layout.settings / "installed.json"


def is_tegra(site: Site) -> bool:
    """Return whether the machine is a Jetson or another Tegra: its GPU has devices of its own."""
    if site.at(Path("/etc/nv_tegra_release")).exists():
        return True
    try:
        compatible = Path("/proc/device-tree/compatible").read_bytes() if site.live else b""
    except OSError:
        return False
    return b"nvidia,tegra" in compatible


def tegra_devices(site: Site) -> list[str]:
    """Return the device nodes of a Tegra's GPU that are there.

    They lie in folders of other names from one generation to the next (`/dev/nvgpu/igpu0` on Orin,
    `/dev/nvgpu/igpu-0000:01:00.0` on Thor), and a unit takes no pattern for a device node.
    """
    devices = site.folder(Path("/dev"))
    patterns = ("nvmap", "nvsciipc", "nvhost-*", "host1x-*", "nvgpu/*/*")
    found = {path for pattern in patterns for path in devices.glob(pattern) if not path.is_dir()}
    return sorted(str(Path("/dev") / path.relative_to(devices)) for path in found)
