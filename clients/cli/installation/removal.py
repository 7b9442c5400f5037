"""The steps of `vramctl uninstall`, in the order in which they are performed."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vram_arbiter.clients.cli.installation.machine import (
    Services,
    command,
    has_group,
    has_user,
    is_member,
    members,
)
from vram_arbiter.clients.cli.installation.record import Record
from vram_arbiter.clients.cli.installation.site import (
    ARBITER,
    CLIENTS,
    DEVICE_GROUPS,
    OF_USER,
    Site,
)
from vram_arbiter.clients.cli.installation.steps import Files, Step, remove_tree, store
from vram_arbiter.clients.net.request import Unreachable, ask
from vram_arbiter.schemas.runtime.endpoints import IPC, SYSTEM_RUNTIME, arbiter_endpoint

SYSTEM_ENDPOINT = f"{IPC}{SYSTEM_RUNTIME}/arbiter.sock"


@dataclass(frozen=True, slots=True)
class Removal:
    """The plan of one removal. `purge`: state, settings, users and changed files too."""

    site: Site
    record: Record
    purge: bool

    def steps(self) -> list[Step]:
        files = Files(self.site, self.record)
        steps = self._units() if self.site.live else []
        steps += files.remove(edited=self.purge)
        steps += [Step("keep", f"{path}: not installed by vramctl") for path in self._drop_ins()]
        if self.site.live and any(step.changes for step in steps):
            services = Services(self.site.layout.system)
            reload = partial(services.ctl, "daemon-reload")
            steps.append(Step("run", "systemctl daemon-reload", perform=reload))
        if self.purge:
            steps += self._trees(self.site.layout.state)
            # after the state: a folder must not belong to a user id that is given away again
            steps += self._accounts() if self.site.live else []
            # last, with the record: what failed can be tried again
            steps += self._trees([self.site.layout.settings])
        elif self.record.users or self.record.groups or self.record.memberships:
            return [*steps, Step("same", f"{self.site.record}, for --purge", perform=self._keep)]
        return [*steps, Step("remove", str(self.site.record), perform=self._forget)]

    def _units(self) -> list[Step]:
        """Stop what runs, the arbiter last."""
        layout = self.site.layout
        services = Services(layout.system)
        names = (ARBITER, *CLIENTS) if layout.system else OF_USER
        mine = [name for name in names if layout.units / name in self.record.files]
        found = services.known([name.replace("@.", "@*.") for name in mine], layout.units)
        held = _holders(layout.system) if found else []
        told = [f"these hold a lease, and unload without an arbiter: {', '.join(held)}"]
        return [
            Step(
                "stop", unit, told if held and unit == ARBITER else (),
                partial(self._stop, services, unit),
            )
            for unit in sorted(found, key=lambda unit: unit == ARBITER)
        ]  # fmt: skip

    def _stop(self, services: Services, unit: str) -> None:
        services.ctl("disable", "--now", unit)
        self.record.enabled = [name for name in self.record.enabled if name != unit]

    def _drop_ins(self) -> list[Path]:
        """Return the settings that an operator added to the units (`systemctl edit`)."""
        units = self.site.folder(self.site.layout.units)
        found = units.glob("vram-*.service.d/*")
        paths = (self.site.layout.units / path.relative_to(units) for path in found)
        return sorted(path for path in paths if path not in self.record.files)

    def _trees(self, paths: Iterable[Path]) -> list[Step]:
        there = [path for path in paths if self.site.at(path).exists()]
        return [
            Step("remove", f"{path}, with all that is in it", perform=partial(self._clear, path))
            for path in there
        ]

    def _clear(self, path: Path) -> None:
        remove_tree(self.site.at(path))

    def _accounts(self) -> list[Step]:
        steps = []
        for user, group in self.record.memberships:
            if group not in self.record.groups and is_member(user, group):
                leave = partial(command, "gpasswd", "--delete", user, group)
                steps.append(Step("remove", f"{user} from {group}", perform=leave))
        for user in self.record.users:
            if has_user(user):
                userdel = partial(command, "userdel", user)
                steps.append(Step("remove", f"user {user}", perform=userdel))
        for group in self.record.groups:
            users = members(group) if has_group(group) and group in DEVICE_GROUPS else []
            if users:
                steps.append(Step("keep", f"group {group}: {', '.join(users)} belong to it"))
            elif has_group(group):
                groupdel = partial(_remove_group, group)
                steps.append(Step("remove", f"group {group}", perform=groupdel))
        return steps

    def _keep(self) -> None:
        """Keep the record of the users that were made, for a later --purge."""
        files = Files(self.site, self.record)
        files.remove_folders()
        store(files)

    def _forget(self) -> None:
        self.site.at(self.site.record).unlink(missing_ok=True)
        Files(self.site, self.record).remove_folders()


def _holders(system: bool) -> list[str]:
    """Return the consumers that hold a lease of the arbiter to be stopped."""
    endpoint = SYSTEM_ENDPOINT if system else arbiter_endpoint(os.environ, os.getuid())
    try:
        reply = ask("status", {}, endpoint)
    except Unreachable:
        return []
    return [lease["consumer"] for lease in reply.get("leases", ()) if lease["charge_bytes"]]


def _remove_group(group: str) -> None:
    if has_group(group):  # userdel removes a group of the user's name
        command("groupdel", group)
