"""Sidecars of a deployment that run on a GPU server: their sockets on this robot, and the server's
arbiter, which has their leases and at which goals mark their uses.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.remote.ssh import forwarded
from vram_arbiter.runner.cli.common import check_sidecars
from vram_arbiter.runner.cli.deployment import DeploymentFile
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.runtime.endpoints import sidecar_name

type Remote = Mapping[str, tuple[str, str]]
"""Endpoints of a skill's sidecar and of its arbiter, by skill."""


def remote_sidecars(
    file: DeploymentFile, installed: Collection[RSkillManifest], environ: Mapping[str, str]
) -> Remote:
    """Return the file's `sidecars`, through the tunnels that are up.

    Raises ConfigError with every entry that names no server or no installed skill,
    SidecarUnavailable where a tunnel is missing.
    """
    found: dict[str, tuple[str, str]] = {}
    problems: list[tuple[str, str]] = []
    for key, address in file.robot.sidecars.items():
        named = [one.name for one in installed if key in (one.name, sidecar_name(one.name))]
        try:
            check_sidecars(dict.fromkeys(named or [key], address), installed)
            found |= dict.fromkeys(named, forwarded(address, environ, os.getuid()))
        except ConfigError as error:
            problems.append((f"sidecars.{key}", str(error)))
    if problems:
        raise file.error(*problems)
    return found


async def connect_servers(
    remote: Remote, stack: contextlib.AsyncExitStack
) -> dict[str, AsyncClient]:
    """Return a client of the arbiter of each skill. Raises ArbiterUnreachable: a robot does not
    start half-safe."""
    clients = {
        endpoint: await stack.enter_async_context(AsyncClient("runner", endpoint=endpoint))
        for endpoint in sorted({arbiter for _, arbiter in remote.values()})
    }
    return {skill: clients[arbiter] for skill, (_, arbiter) in remote.items()}
