"""The steps of `vramctl install`, in the order in which they are performed."""

import os
import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vram_arbiter.clients.cli.installation.contents import Contents
from vram_arbiter.clients.cli.installation.machine import (
    Services,
    command,
    has_group,
    has_user,
    is_member,
)
from vram_arbiter.clients.cli.installation.record import Record
from vram_arbiter.clients.cli.installation.site import ARBITER, OPERATORS, Site
from vram_arbiter.clients.cli.installation.steps import Files, Step
from vram_arbiter.schemas.errors import ConfigError, InstallFailed

SYSUSERS = Path("/etc/sysusers.d/vram-arbiter.conf")
TMPFILES = Path("/etc/tmpfiles.d/vram-arbiter.conf")
RUNTIME = Path("/run/vram-arbiter")
NO_START = (
    "see `journalctl -u vram-arbiter -n 20`; without a GPU write "
    'ARBITER_OPTIONS="--gpu fake:8GiB" into /etc/vram-arbiter/arbiter.env; then install again'
)


@dataclass(frozen=True, slots=True)
class Installation:
    """The plan of one installation; its steps keep `record` up to date."""

    site: Site
    record: Record
    wanted: Contents
    operators: tuple[str, ...] = ()

    def steps(self) -> list[Step]:
        """Raises ConfigError for an operator who is not a user."""
        layout = self.site.layout
        steps = Files(self.site, self.record).install(self.wanted)
        if not self.site.live:
            return steps
        services = Services(layout.system)
        units_change = any(step.changes and str(layout.units) in step.what for step in steps)
        if layout.system:
            steps += [*self._users(), *self._members(), *self._folders()]
        if units_change:
            reload = partial(services.ctl, "daemon-reload")
            steps.append(Step("run", "systemctl daemon-reload", perform=reload))
        return [*steps, self._unit(services)]

    def _users(self) -> list[Step]:
        """Users, groups and memberships of the sysusers.d snippet."""
        text = self.wanted.files[SYSUSERS]
        users = [name for name in re.findall(r"^u (\S+)", text, re.M) if not has_user(name)]
        # a user has a group of its name
        groups = [name for name in re.findall(r"^[gu] (\S+)", text, re.M) if not has_group(name)]
        members = re.findall(r"^m (\S+) (\S+)", text, re.M)
        missing = [f"{user} in {group}" for user, group in members if not is_member(user, group)]
        if not users and not groups and not missing:
            return [Step("same", "users and groups")]
        told = (("users", users), ("groups", groups), ("members", missing))
        says = "; ".join(f"{what} {', '.join(names)}" for what, names in told if names)

        def create() -> None:
            command("systemd-sysusers", str(SYSUSERS))
            self.record.users += users
            self.record.groups += groups

        return [Step("create", says, perform=create)]

    def _members(self) -> list[Step]:
        """Operators belong to both groups: a socket has one, and only its members connect."""
        steps = []
        for user in self.operators:
            if not has_user(user):
                raise ConfigError(
                    f"--operators names {user!r}, which is not a user of this machine"
                )
            missing = [g for g in (self.record.group, OPERATORS) if not is_member(user, g)]
            if not missing:
                steps.append(Step("same", f"{user} is an operator"))
                continue

            def add(user: str = user, missing: list[str] = missing) -> None:
                command("usermod", "--append", "--groups", ",".join(missing), user)
                self.record.memberships += [(user, group) for group in missing]

            steps.append(Step("add", f"{user} to {' and '.join(missing)}", perform=add))
        return steps

    def _folders(self) -> list[Step]:
        """The folder of the sockets, so that sidecars can start before the arbiter does."""
        if RUNTIME.is_dir():
            return [Step("same", str(RUNTIME))]

        def create() -> None:
            command("systemd-tmpfiles", "--create", str(TMPFILES))

        return [Step("create", str(RUNTIME), perform=create)]

    def _unit(self, services: Services) -> Step:
        """Enable and start the arbiter once; afterwards its state is the operator's choice."""
        if ARBITER in self.record.enabled:
            said = [
                "enabled" if services.is_enabled(ARBITER) else "disabled",
                "running" if services.is_active(ARBITER) else "stopped",
            ]
            return Step("same", f"{ARBITER} ({', '.join(said)})")

        def start() -> None:
            services.ctl("enable", ARBITER)
            try:
                services.ctl("start", ARBITER)
            except InstallFailed as error:
                raise InstallFailed(
                    f"{ARBITER} does not start: {error.message}", hint=NO_START
                ) from error
            self.record.enabled.append(ARBITER)

        return Step("start", f"{ARBITER}, now and at every boot", perform=start)


def check_rights(site: Site, *, what: str) -> None:
    """Raises ConfigError where the calling user cannot change what belongs to the installation."""
    if not site.live:
        return
    if site.layout.system and os.getuid() != 0:
        raise ConfigError(
            f"`vramctl {what}` of the machine's units needs root",
            hint=f"run it with sudo, or `vramctl {what} --user-units` for an arbiter of your own; "
            "--dry-run shows the plan to anyone",
        )
    if not site.layout.system and os.getuid() == 0:
        raise ConfigError(
            "--user-units as root: root's arbiter is the machine's",
            hint="run it without sudo, or leave --user-units out",
        )
