"""`vramctl install` and `vramctl uninstall`: show the plan, ask, perform it.

Files are written here; systemd-sysusers makes the users, systemd-tmpfiles the folders.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.installation.contents import OF_SNIPPETS, wanted
from vram_arbiter.clients.cli.installation.environment import AS_A_UNIT, check_environment
from vram_arbiter.clients.cli.installation.files import Files, Installed, Step, load
from vram_arbiter.clients.cli.installation.site import ARBITER, SYSTEM, Site, site_of_user
from vram_arbiter.clients.cli.replies import NO, OK
from vram_arbiter.schemas.errors import InstallFailed
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version

DESCRIPTIONS = {
    "install": "Make the arbiter a service of this machine, or of your user with --user-units. "
    "Shows the plan and asks first. Repeating it, or an upgrade, changes only what differs; a file "
    "that was changed by hand is kept.",
    "uninstall": "Remove what `vramctl install` put on this machine, after showing the plan. Files "
    "changed by hand, state and settings stay, unless --purge; users and groups stay in any case.",
}
HINT: Final = (
    "mend it, then run the command again; `journalctl -u vram-arbiter -n 20` says why the arbiter "
    "does not start, without a GPU see docs/how-to/systemd.md"
)
_BOOTED: Final = Path("/run/systemd/system")


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    if command == "install":
        add(
            "--prefix", metavar="DIR", type=Path, default=Path(sys.prefix),
            help="with --root: environment whose programs the units start there (default: "
            "%(default)s)",
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
    site = site_of_user(os.environ) if args.user_units else SYSTEM
    site = replace(site, root=args.root.absolute())
    if site.live and not _BOOTED.is_dir():
        args.parser.error("systemd does not run here: write only the files, with --root /FOLDER")
    if site.live and site.system and os.getuid() != 0 and not args.dry_run:
        args.parser.error("the machine's units need root: use sudo, --user-units or --dry-run")
    record = load(site)
    if args.command_name == "install":
        steps = _installation(args, site, record)
    else:
        steps = _removal(site, record, purge=args.purge)
    if (code := _confirm(args, steps)) is not None:
        return code
    started, installing = record.started, args.command_name == "install"
    try:
        for step in steps:
            if step.perform is not None:
                step.perform()
        record.started = installing and site.live
    except OSError as error:
        raise InstallFailed(f"{step.what}: {error.strerror}", hint=HINT) from error
    finally:
        Files(site, record).store()
    if started and installing:
        print("next:", *_systemctl(site, "try-restart", ARBITER), "(holders keep their leases)")
    return OK


# -- plans
def _installation(args: argparse.Namespace, site: Site, record: Installed) -> list[Step]:
    """Return the steps of an installation; they keep `record` up to date. Raises ConfigError."""
    prefix = args.prefix
    if not re.fullmatch("/[A-Za-z0-9._+/-]*", str(prefix)) or ".." in prefix.parts:
        args.parser.error(f"--prefix: expected a path of letters, digits and /._+-, got '{prefix}'")
    if site.live and prefix != Path(sys.prefix):
        args.parser.error(f"--prefix is for --root: run the vramctl of {prefix}")
    if site.live and site.system:
        check_environment()
    print(f"vram-arbiter {version()} from {prefix}:")
    steps = Files(site, record).plan(wanted(site, prefix))
    changed = any(step.perform for step in steps)
    if site.live and (changed or not record.started):
        if site.system:
            what = f"that a unit can run {sys.executable}"
            steps.insert(0, Step("check", what, partial(_command, *AS_A_UNIT)))
            steps += [_running(*command) for command in OF_SNIPPETS]
        steps.append(_running(*_systemctl(site, "daemon-reload")))
    if site.live and not record.started:  # once; afterwards its state is the operator's choice
        steps.append(_running(*_systemctl(site, "enable", "--now", ARBITER)))
    return steps


def _removal(site: Site, record: Installed, *, purge: bool) -> list[Step]:
    """Return the steps of a removal. `purge`: state, settings and changed files too."""
    ours = [path for path in record.files if path.parent == site.units]
    units = [path.name for path in ours if site.at(path).exists()]
    units.sort(key=ARBITER.__eq__)  # stopped last
    steps = Files(site, record).plan({}, purge=purge)
    if site.live and units:
        running = [name.replace("@.", "@*.") for name in units]
        steps = [
            _running(*_systemctl(site, "stop", *running)),
            _running(*_systemctl(site, "disable", *units)),
            *steps,
            _running(*_systemctl(site, "daemon-reload")),
        ]
    trees = [str(place) for path in site.trees() if os.path.lexists(place := site.at(path))]
    if purge and trees:
        steps.append(_running("rm", "--recursive", "--", *trees))  # follows no link
    return steps


# -- performing
def _running(*argv: str) -> Step:
    return Step("run", " ".join(argv), partial(_command, *argv))


def _systemctl(site: Site, *arguments: str) -> list[str]:
    return ["systemctl", *([] if site.system else ["--user"]), *arguments]


def _command(*argv: str) -> None:
    """Run a command of the machine. Raises InstallFailed, OSError."""
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).replace("\n", "; ")
        raise InstallFailed(f"{argv[0]} failed with {done.returncode}: {said}", hint=HINT)


def _confirm(args: argparse.Namespace, steps: Sequence[Step]) -> int | None:
    """Show the plan and ask. Returns the exit code if it is not to be performed."""
    for step in steps:
        print(printable(f"  {step.verb:<8}{step.what}"))
    if not any(step.perform for step in steps):
        print("nothing to change")
        return OK
    if args.dry_run or args.yes:
        return OK if args.dry_run else None
    print("Proceed? [y/N] ", end="", flush=True)
    if sys.stdin.readline().strip().lower() in ("y", "yes"):
        return None
    print("nothing was changed")
    return NO
