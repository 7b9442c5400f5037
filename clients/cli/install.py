"""`vramctl install` and `vramctl uninstall`: show the plan, ask, perform it.

Files are written here; systemd-sysusers makes the users, systemd-tmpfiles the folders.
"""

import argparse
import os
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.installation.contents import SYSUSERS, TMPFILES, wanted
from vram_arbiter.clients.cli.installation.environment import check_environment
from vram_arbiter.clients.cli.installation.files import Files, Installed, Step, load
from vram_arbiter.clients.cli.installation.machine import (
    check_systemd,
    command,
    exists,
    is_active,
    known_units,
    missing_accounts,
    systemctl,
)
from vram_arbiter.clients.cli.installation.site import (
    ARBITER,
    CLIENTS,
    GROUP,
    OF_USER,
    SYSTEM,
    Site,
    layout_of_user,
)
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.errors import ConfigError, InstallFailed, VramError
from vram_arbiter.schemas.runtime.endpoints import IPC, SYSTEM_RUNTIME, arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version
from vram_arbiter.schemas.wire.requests import Status

DESCRIPTIONS = {
    "install": "Make the arbiter a service of this machine, or of your user with --user-units: "
    "units, users, groups, folders, links to the programs, shell completion. Shows the plan and "
    "asks first. Repeating it, or an upgrade, changes only what differs; a file that was changed "
    "by hand is kept.",
    "uninstall": "Remove what `vramctl install` put on this machine, after showing the plan. Files "
    "that were changed by hand stay, and so do state and settings, unless --purge. Users and "
    "groups stay in any case.",
}
NO_START: Final = (
    "see `journalctl -u vram-arbiter -n 20`; without a GPU write "
    'ARBITER_OPTIONS="--gpu fake:8GiB" into /etc/vram-arbiter/arbiter.env; then install again'
)
RUNTIME: Final = Path("/run/vram-arbiter")
_NAME: Final = re.compile(r"[a-z_][a-z0-9_-]{0,30}")
_PLAIN: Final = re.compile(r"/[A-Za-z0-9._+/-]*")
"""What a unit file holds as it is."""


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    if command == "install":
        add(
            "--prefix", metavar="DIR", type=Path,
            help="environment whose programs the units start (default: the one of this vramctl)",
        )  # fmt: skip
        add(
            "--group",
            help=f"group that may connect and hold leases (default: {GROUP}, or that of the last "
            "installation)",
        )
        add(
            "--operators", metavar="USERS", default="",
            help="users who may evict, pin and drain: alice,bob",
        )  # fmt: skip
    else:
        add(
            "--purge", action="store_true",
            help="also remove state, caches, settings, and files that were changed by hand",
        )  # fmt: skip
    add("--user-units", action="store_true", help="the calling user's systemd; needs no root")
    add(
        "--root", metavar="DIR", type=Path, default=Path("/"),
        help="write files only, below this folder: for an image or a package",
    )  # fmt: skip
    add("--dry-run", action="store_true", help="show the plan and exit")
    add("--yes", action="store_true", help="do not ask")


def run(args: argparse.Namespace) -> int:
    layout = layout_of_user(os.environ) if args.user_units else SYSTEM
    site = Site(layout, args.root.absolute())
    if site.live:
        if not args.dry_run:
            _check_rights(args.command_name, system=layout.system)
        check_systemd(system=layout.system)
    before = load(site)
    if args.command_name == "install":
        return _install(args, site, before)
    if before is None:
        print(f"nothing is installed: not found: {site.at(site.record)}")
        return OK
    steps = removal(site, before, purge=args.purge)
    if (code := _confirm(args, steps)) is not None:
        return code
    _perform(steps)
    kept = "" if args.purge else f"; `{before.prefix}/bin/vramctl uninstall --purge` removes state"
    if site.live and site.layout.system:
        kept += "; users and groups stay, with their members"
    print(f"next: the programs stay in {before.prefix}{kept}")
    return OK


def _install(args: argparse.Namespace, site: Site, before: Installed | None) -> int:
    prefix = args.prefix or Path(sys.prefix)
    if not _PLAIN.fullmatch(str(prefix)) or ".." in prefix.parts:
        raise ConfigError(
            f"expected an absolute path of letters, digits and ._+- for --prefix, got '{prefix}'",
            hint="a unit file gives other characters a meaning",
        )
    if site.live:
        check_environment(prefix, system=site.layout.system)
    record = before.model_copy(deep=True) if before else Installed()
    record.group = _checked(args.group or record.group, "group")
    record.version, record.prefix = version(), prefix
    operators = [_checked(name, "user") for name in args.operators.split(",") if name]
    if operators and not (site.layout.system and site.live):
        raise ConfigError("--operators needs the machine's units", hint="leave it out")
    for name in operators:
        if not exists("user", name):
            raise ConfigError(f"--operators names {name!r}, which is not a user of this machine")
    record.operators = list(dict.fromkeys([*record.operators, *operators]))
    steps = installation(site, record)
    what = "this machine" if site.layout.system else "this user"
    print(f"vram-arbiter {version()} from {prefix} for {what if site.live else site.root}:")
    changing = any(step.changes for step in steps)
    if (code := _confirm(args, steps)) is not None:
        return code
    system = site.layout.system
    runs = site.live and before is not None and is_active(ARBITER, system=system)
    try:
        _perform(steps)
    finally:
        if record != before:
            Files(site, record).store()
    if runs and changing:
        user = "" if system else "--user "
        print(f"next: systemctl {user}restart vram-arbiter (holders keep their leases)")
    return OK


def _checked(name: str, what: str) -> str:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"expected the name of a {what}, got {name!r}")
    return name


def _check_rights(what: str, *, system: bool) -> None:
    """Raises ConfigError where the calling user cannot change what belongs to the installation."""
    if system and os.getuid() != 0:
        raise ConfigError(
            f"`vramctl {what}` of the machine's units needs root",
            hint=f"run it with sudo, or `vramctl {what} --user-units` for an arbiter of your own; "
            "--dry-run shows the plan to anyone",
        )
    if not system and os.getuid() == 0:
        raise ConfigError(
            "--user-units as root: root's arbiter is the machine's",
            hint="run it without sudo, or leave --user-units out",
        )


# -- plans
def installation(site: Site, record: Installed) -> list[Step]:
    """Return the steps of an installation; they keep `record` up to date."""
    layout = site.layout
    texts = wanted(site, record.prefix, record.group, record.operators)
    steps = Files(site, record).install(texts)
    if not site.live:
        return steps
    changed = [step.what for step in steps if step.changes]
    if layout.system:
        missing = missing_accounts(texts[SYSUSERS])
        if missing or str(SYSUSERS) in changed:
            made = _running("systemd-sysusers", str(SYSUSERS))
            steps.append(replace(made, detail=[f"{kind} {name}" for kind, name in missing]))
        if not RUNTIME.is_dir():
            steps.append(_running("systemd-tmpfiles", "--create", str(TMPFILES)))
    if any(what.startswith(str(layout.units)) for what in changed):
        steps.append(_running(*systemctl("daemon-reload", system=layout.system)))

    def start() -> None:
        try:
            command(*systemctl("enable", "--now", ARBITER, system=layout.system))
        except InstallFailed as error:
            said = f"{ARBITER} does not start: {error.message}"
            raise InstallFailed(said, hint=NO_START) from error
        record.started = True

    if record.started:  # once; afterwards its state is the operator's choice
        return [*steps, Step("same", ARBITER)]
    return [*steps, Step("start", f"{ARBITER}, now and at every boot", perform=start)]


def removal(site: Site, record: Installed, *, purge: bool) -> list[Step]:
    """Return the steps of a removal. `purge`: state, settings and changed files too."""
    files, layout = Files(site, record), site.layout
    steps = _stops(site, record) if site.live else []
    steps += files.remove(purge=purge)
    units = site.folder(layout.units)
    for path in sorted(units.glob("vram-*.service.d/*")):  # of `systemctl edit`
        drop_in = layout.units / path.relative_to(units)
        if drop_in not in record.files:
            steps.append(Step("keep", f"{drop_in}: not installed by vramctl"))
    if site.live and any(step.changes for step in steps):
        steps.append(_running(*systemctl("daemon-reload", system=layout.system)))
    if purge:
        steps += _trees(site, layout.state)
        # last, with the record: what failed can be tried again
        steps += _trees(site, [layout.settings])

    def end() -> None:
        record.started = False
        if keeps:
            files.store()
        else:
            site.at(site.record).unlink(missing_ok=True)
        files.remove_folders()

    keeps = not purge and site.live and layout.system
    what = f"{site.record}, for --purge" if keeps else str(site.record)
    return [*steps, Step("same" if keeps else "remove", what, perform=end)]


def _running(*argv: str) -> Step:
    return Step("run", " ".join(argv), perform=partial(command, *argv))


def _stops(site: Site, record: Installed) -> list[Step]:
    """Stop what runs, the arbiter last."""
    layout = site.layout
    names = (ARBITER, *CLIENTS) if layout.system else OF_USER
    mine = [name.replace("@.", "@*.") for name in names if layout.units / name in record.files]
    if not mine:
        return []
    found = known_units(mine, layout.units, system=layout.system)
    endpoint = f"{IPC}{SYSTEM_RUNTIME}/arbiter.sock"
    if not layout.system:
        endpoint = arbiter_endpoint(os.environ, os.getuid())
    try:
        leases = ask(Status(), endpoint).get("leases", ()) if found else ()
    except VramError:
        leases = ()
    held = ", ".join(lease["consumer"] for lease in leases if lease["charge_bytes"])
    told = [f"these hold a lease, and unload without an arbiter: {held}"] if held else []
    return [
        Step(
            "stop", unit, told if unit == ARBITER else (),
            partial(command, *systemctl("disable", "--now", unit, system=layout.system)),
        )
        for unit in sorted(found, key=lambda unit: unit == ARBITER)
    ]  # fmt: skip


def _trees(site: Site, paths: Iterable[Path]) -> list[Step]:
    return [
        Step("remove", f"{path}, with all that is in it", perform=partial(_clear, site.at(path)))
        for path in paths
        if site.at(path).exists()
    ]


def _clear(place: Path) -> None:
    """Remove a folder with all that is in it; a link is removed, not what it leads to."""
    if place.is_symlink():
        place.unlink()
    else:
        shutil.rmtree(place)


# -- performing
def _confirm(args: argparse.Namespace, steps: Sequence[Step]) -> int | None:
    """Show the plan and ask. Returns the exit code if it is not to be performed.

    Raises ConfigError without a terminal to ask at.
    """
    for step in steps:
        print(printable(f"  {step.verb:<8}{step.what}"))
        for line in step.detail:
            print(printable(f"          {line}"))
    if args.dry_run:
        return OK
    if not any(step.changes for step in steps):
        print("nothing to change")
        return None
    if args.yes:
        return None
    if not sys.stdin.isatty():
        raise ConfigError(
            "the plan needs a yes, and the input is not a terminal",
            hint="--yes performs it, --dry-run only shows it",
        )
    try:
        answer = input("Proceed? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() in ("y", "yes"):
        return None
    print("nothing was changed")
    return NO


def _perform(steps: Sequence[Step]) -> None:
    for step in steps:
        try:
            if step.perform is not None:
                step.perform()
        except OSError as error:
            raise InstallFailed(
                f"{step.what}: {error.strerror}", hint="fix it, then run the command again"
            ) from error
