"""What an installation consists of: the shipped units and snippets for one environment, links to
the programs, and shell completions. It reads shipped files and compares nothing.
"""

from pathlib import Path

import vram_arbiter
from vram_arbiter.clients.cli.installation.completion import completions
from vram_arbiter.clients.cli.installation.site import LINK, PROGRAMS, Site, tegra_devices

SYSUSERS, TMPFILES, PROFILE = (
    f"/etc/{name}.d/vram-arbiter.{kind}"
    for name, kind in (("sysusers", "conf"), ("tmpfiles", "conf"), ("profile", "sh"))
)
OF_SNIPPETS = (("systemd-sysusers", SYSUSERS), ("systemd-tmpfiles", "--create", TMPFILES))
SSHD = Path("/etc/ssh/sshd_config.d")
SHIPPED = Path(vram_arbiter.__file__).parent / "configs"
_PREFIX = "/opt/vram-arbiter"  # of the shipped files
_ON_GPU = ("vram-arbiter.service", "vram-sidecar@.service", "vram-runner@.service")


def wanted(site: Site, prefix: Path) -> dict[Path, str]:
    """Return the texts of the files and links that belong on the machine, by their paths there."""
    units = SHIPPED / "systemd" / ("system" if site.system else "user")
    shipped = {
        site.units / path.relative_to(units): path.read_text(encoding="utf-8")
        for path in sorted(units.rglob("*"))
        if path.is_file()
    }
    if site.system:
        for name in (SYSUSERS, TMPFILES, PROFILE):
            shipped[Path(name)] = _read(f"systemd/{name.removeprefix('/etc/')}")
        shipped |= _of_tegra(site)
        if site.folder(SSHD).is_dir():  # robots come by ssh, or not at all
            shipped[SSHD / "vram-guests.conf"] = _read("ssh/vram-guests.conf")
    files = {path: text.replace(_PREFIX, str(prefix)) for path, text in shipped.items()}
    for name in ("arbiter.yaml", "observer.yaml"):
        example = _read(name).replace("$schema=../", f"$schema={SHIPPED.parent}/", 1)  # for editors
        files[site.settings / f"{name}.example"] = example
    for place, text in completions().items():
        files[site.shared / place] = text
    if prefix / "bin" != site.programs:
        for name in PROGRAMS:
            files[site.programs / name] = f"{LINK}{prefix}/bin/{name}"
    return files


def _of_tegra(site: Site) -> dict[Path, str]:
    devices = tegra_devices(site)
    if not devices and not site.at(Path("/etc/nv_tegra_release")).exists():
        return {}
    lines = [f"DeviceAllow={device} rw\n" for device in devices]
    text = "".join([_read("systemd/tegra.conf"), *lines])
    return {site.units / f"{name}.d" / "tegra.conf": text for name in _ON_GPU}


def _read(name: str) -> str:
    return (SHIPPED / name).read_text(encoding="utf-8")
