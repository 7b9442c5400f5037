"""What a peer may be: visible, and perhaps an operator. Which process it is, and whether it is a
guest, says `schemas.runtime.peercred`.

Must not know sessions or requests.
"""

import grp
import os
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError, NotPermitted
from vram_arbiter.schemas.runtime.peercred import Peer


def check_visible(peer: Peer) -> None:
    """Raises NotPermitted for a process of another pid namespace: its death could not be seen."""
    if peer.process.pid == 0:
        raise NotPermitted(
            "the process at the other end cannot be seen from here: it runs in another pid "
            "namespace, not below the arbiter's",
            hint="run the arbiter in the host's pid namespace (docker: --pid=host); clients may be "
            "in containers",
        )


def is_operator(peer: Peer, operators_gid: int | None) -> bool:
    """Root, the daemon's own user, or a member (primary or supplementary) of the
    operators' group."""
    if peer.uid in (0, os.getuid()):
        return True
    return operators_gid is not None and peer.belongs_to(operators_gid)


def check_cgroup(peer: Peer, cgroup: str, root: Path | None, operators_gid: int | None) -> None:
    """Raises NotPermitted for a cgroup whose bytes a lease of this peer may not have.

    An operator may name any. Another user may name one whose folder, or as long as it does not
    exist the nearest folder above it, is that user's: only that user can make it, and move
    processes there. `root`: where the hierarchy is mounted.
    """
    if root is None:
        raise NotPermitted(
            f"the cgroup {cgroup} cannot be seen from here",
            hint="mount the cgroup v2 hierarchy of the host (docker: --cgroupns=host)",
        )
    if is_operator(peer, operators_gid):
        return
    folder = root / cgroup[1:]
    owner = next(uid for uid in map(_uid_of, (folder, *folder.parents)) if uid is not None)
    if owner != peer.uid:
        raise NotPermitted(
            f"the cgroup {cgroup} belongs to uid {owner}, not to {peer.uid}",
            hint="name a unit or container of your own user (systemctl --user), or ask as an "
            "operator",
            details={"cgroup": cgroup, "uid": owner},
        )


def _uid_of(folder: Path) -> int | None:
    try:
        return folder.stat().st_uid
    except OSError:  # it does not exist, or its name is too long for one
        return None


def how_to_operate(operators_gid: int | None) -> str:
    """What a peer that may not act by hand can do, with the group's name."""
    if operators_gid is None:
        return (
            "use its user or root, or let the daemon name a group (wire.operators_group); looking "
            "is open to observers"
        )
    try:
        name = grp.getgrgid(operators_gid).gr_name
    except KeyError:
        name = str(operators_gid)
    return (
        f"use its user or root, or join the group {name} (wire.operators_group, then log in "
        "again); observers may look"
    )


def group_id(key: str, name: str | None) -> int | None:
    """Number of the Unix group that the configuration names under `key`. Raises ConfigError."""
    if name is None:
        return None
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise ConfigError(
            f"{key}: no group {name!r} on this machine", hint=f"groupadd --system {name}"
        ) from None
