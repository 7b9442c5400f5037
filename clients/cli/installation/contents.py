"""What an installation consists of: the shipped units and snippets for one environment and group,
links to the programs, and shell completions. It reads shipped files and compares nothing.
"""

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import vram_arbiter
from vram_arbiter.clients.cli.installation.completion import completions
from vram_arbiter.clients.cli.installation.site import (
    ARBITER,
    CLIENTS,
    GROUP,
    LINK,
    OF_USER,
    OPERATORS,
    PROGRAMS,
    Site,
    is_tegra,
    tegra_devices,
)

SYSUSERS = Path("/etc/sysusers.d/vram-arbiter.conf")
TMPFILES = Path("/etc/tmpfiles.d/vram-arbiter.conf")
SHIPPED = Path(vram_arbiter.__file__).parent / "configs"
_PREFIX = "/opt/vram-arbiter"  # of the shipped files
_ON_GPU = ("vram-arbiter.service", "vram-sidecar@.service", "vram-runner@.service")


def wanted(site: Site, prefix: Path, group: str, operators: Sequence[str] = ()) -> dict[Path, str]:
    """Return the texts of the files and links that belong on the machine, by their paths there."""
    files = _files_of_system(site) if site.layout.system else _files_of_user(site)
    files = {path: _adapted(text, prefix, group) for path, text in files.items()}
    for name in operators:  # a socket has one group, and only its members connect
        files[SYSUSERS] += f"m {name} {group}\nm {name} {OPERATORS}\n"
    settings, shared = site.layout.settings, site.layout.shared
    for name in ("arbiter.yaml", "observer.yaml"):
        files[settings / f"{name}.example"] = _example(name, prefix)
    for place, text in completions().items():
        files[shared / place] = text
    if prefix / "bin" != site.layout.programs:
        for name in PROGRAMS:
            files[site.layout.programs / name] = f"{LINK}{prefix}/bin/{name}"
    return files


def _files_of_system(site: Site) -> dict[Path, str]:
    units = site.layout.units
    files = {units / name: _read(f"systemd/system/{name}") for name in (ARBITER, *CLIENTS)}
    for path in sorted((SHIPPED / f"systemd/system/{ARBITER}.d").iterdir()):
        files[units / f"{ARBITER}.d" / path.name] = path.read_text(encoding="utf-8")
    for path in (SYSUSERS, TMPFILES, Path("/etc/profile.d/vram-arbiter.sh")):
        files[path] = _read(f"systemd/{path.relative_to('/etc')}")
    if is_tegra(site):
        text = tegra_drop_in(_read("systemd/tegra.conf"), tegra_devices(site))
        files |= {units / f"{name}.d" / "tegra.conf": text for name in _ON_GPU}
    return files


def _files_of_user(site: Site) -> dict[Path, str]:
    return {site.layout.units / name: _read(f"systemd/user/{name}") for name in OF_USER}


def tegra_drop_in(text: str, devices: list[str]) -> str:
    """Return the shipped drop-in with the device nodes of this machine that it does not name."""
    lines = [f"DeviceAllow={device} rw" for device in devices]
    return text + "".join(f"{line}\n" for line in lines if line not in text.splitlines())


def _example(name: str, prefix: Path) -> str:
    """Return a commented example that names the schema of the environment `prefix` for editors."""
    package, here = SHIPPED.parent, Path(sys.prefix)
    if package.is_relative_to(here):
        package = prefix / package.relative_to(here)
    return _read(name).replace("$schema=../", f"$schema={package}/", 1)


def _read(name: str) -> str:
    return (SHIPPED / name).read_text(encoding="utf-8")


_GROUPS: tuple[tuple[str, Callable[[str], str]], ...] = (
    (r"^Group=vram-arbiter$", lambda group: f"Group={group}"),
    (r"--group vram-arbiter(?= )", lambda group: f"--group {group}"),
    (r"^(m \S+ +)vram-arbiter$", lambda group: rf"\g<1>{group}"),
    (r"^(d \S+ \d+ vram-arbiter) vram-arbiter", lambda group: rf"\1 {group}"),
    (r"^u vram-arbiter ", lambda group: f"g {group} -\nm vram-arbiter {group}\nu vram-arbiter "),
)
"""Where the shipped files name the group that may connect, and what another one makes of it."""


def _adapted(text: str, prefix: Path, group: str) -> str:
    text = text.replace(_PREFIX, str(prefix))
    if group != GROUP:
        for pattern, other in _GROUPS:
            text = re.sub(pattern, other(group), text, flags=re.MULTILINE)
    return text
