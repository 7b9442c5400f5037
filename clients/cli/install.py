"""`vramctl install` and `vramctl uninstall`: show the plan, ask, perform it."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.clients.cli.installation.contents import wanted
from vram_arbiter.clients.cli.installation.environment import check_environment, check_prefix
from vram_arbiter.clients.cli.installation.install import Installation, check_rights
from vram_arbiter.clients.cli.installation.machine import Services
from vram_arbiter.clients.cli.installation.record import Record, load
from vram_arbiter.clients.cli.installation.removal import Removal
from vram_arbiter.clients.cli.installation.site import (
    ARBITER,
    GROUP,
    SYSTEM,
    Site,
    check_name,
    layout_of_user,
    user_home,
)
from vram_arbiter.clients.cli.installation.steps import Files, Step, store
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.schemas.errors import ConfigError, InstallFailed
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version

DESCRIPTIONS = {
    "install": "Make the arbiter a service of this machine, or of your user with --user-units: "
    "units, users, groups, folders, links to the programs, shell completion. Shows the plan and "
    "asks first. Repeating it, or an upgrade, changes only what differs; a file that was changed "
    "by hand is kept, with the new text beside it as FILE.new.",
    "uninstall": "Remove what `vramctl install` put on this machine, after showing the plan. Files "
    "that were changed by hand stay, and so do state, settings and users, unless --purge.",
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    if command == "install":
        parser.add_argument(
            "--prefix",
            metavar="DIR",
            type=Path,
            help="environment whose programs the units start (default: the one of this vramctl)",
        )
        parser.add_argument(
            "--group",
            help=f"group that may connect and hold leases (default: {GROUP}, or that of the last "
            "installation)",
        )
        parser.add_argument(
            "--operators",
            metavar="USERS",
            default="",
            help="users who may evict, pin and drain: alice,bob",
        )
    else:
        parser.add_argument(
            "--purge",
            action="store_true",
            help="also remove state, caches, settings, users, and files that were changed by hand",
        )
    parser.add_argument(
        "--user-units", action="store_true", help="the calling user's systemd; needs no root"
    )
    parser.add_argument(
        "--root",
        metavar="DIR",
        type=Path,
        default=Path("/"),
        help="write files only, below this folder: for an image or a package",
    )
    parser.add_argument("--dry-run", action="store_true", help="show the plan and exit")
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(args: argparse.Namespace) -> int:
    layout = layout_of_user(os.environ, user_home(os.environ)) if args.user_units else SYSTEM
    site = Site(layout, args.root.absolute())
    if not args.dry_run:
        check_rights(site, what=args.command_name)
    if site.live:
        Services(layout.system).check()
    before = load(site)
    if args.command_name == "uninstall":
        return _uninstall(args, site, before)
    return _install(args, site, before)


def _install(args: argparse.Namespace, site: Site, before: Record | None) -> int:
    prefix = args.prefix or Path(sys.prefix)
    check_prefix(prefix)
    if site.live:
        check_environment(prefix, system=site.layout.system)
    record = before.model_copy(deep=True) if before else Record()
    record.group = check_name(args.group or record.group, "group")
    record.version, record.prefix = version(), prefix
    operators = tuple(check_name(name, "user") for name in args.operators.split(",") if name)
    if operators and not (site.layout.system and site.live):
        raise ConfigError("--operators needs the machine's units", hint="leave it out")
    installation = Installation(site, record, wanted(site, prefix, record.group), operators)
    steps = installation.steps()
    what = "this machine" if site.layout.system else "this user"
    print(f"vram-arbiter {version()} from {prefix} for {what if site.live else site.root}:")
    changing = any(step.changes for step in steps)
    if (code := _confirm(args, steps)) is not None:
        return code
    try:
        _perform(steps)
    finally:
        if record != before:
            store(Files(site, record))
    upgraded = changing and before is not None and ARBITER in before.enabled
    if upgraded and site.live and Services(site.layout.system).is_active(ARBITER):
        user = "" if site.layout.system else "--user "
        print(f"next: systemctl {user}restart vram-arbiter (holders keep their leases)")
    return OK


def _uninstall(args: argparse.Namespace, site: Site, before: Record | None) -> int:
    if before is None:
        print(f"nothing is installed: there is no {site.at(site.record)}")
        return OK
    steps = Removal(site, before, args.purge).steps()
    if (code := _confirm(args, steps)) is not None:
        return code
    _perform(steps)
    kept = "" if args.purge else f"; `{before.prefix}/bin/vramctl uninstall --purge` removes state"
    print(f"next: the programs stay in {before.prefix}{kept}")
    return OK


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
        if step.perform is None:
            continue
        try:
            step.perform()
        except OSError as error:
            raise InstallFailed(
                f"{step.what}: {error.strerror}", hint="fix it, then run the command again"
            ) from error
