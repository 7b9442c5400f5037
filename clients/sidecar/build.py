"""Sidecars from manifests: the one that serves is used, else one is started as a child process.

A child that fails is started again. It ends with the block that started it, and with this process
however that ends (`vram-sidecar --parent`). Another program's sidecar is used and left running.
"""

import asyncio
import contextlib
import logging
import os
import shlex
import sys
from asyncio.subprocess import DEVNULL, Process
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.sidecar.base import CONNECT_TIMEOUT_S, PROBE_S, SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable
from vram_arbiter.schemas.manifest import LICENSE_FLAG, Kind, load_manifest
from vram_arbiter.schemas.runtime.endpoints import program_endpoint, sidecar_name

CLIENTS: Final[Mapping[Kind, type[SidecarClient]]] = {
    Kind.DETECTOR: DetectorClient,
    Kind.VLM: SceneVlmClient,
    Kind.VLA: PolicyClient,
    Kind.REWARD: RewardClient,
}
BOOT_S = 1800.0  # to the first answer: a new environment downloads its packages
END_S = 15.0  # from SIGTERM to SIGKILL: the model leaves at its next safe point
RESTART_S = 2.0  # as of the systemd units
RESTARTS_MAX = 100
ENDED = (0, 2)  # exit codes of `vram-sidecar`: in order; a person has to act
STDERR: Final = 2

log = logging.getLogger(__name__)


def manifest_file(given: str) -> Path | None:
    """Return the `rskill.yaml` that an option names: a file, its folder, or a shipped skill. None:
    it is an endpoint."""
    if "://" in given:
        return None
    path = shipped(Path(given), "rskills", configs_folder(os.environ))
    return path / "rskill.yaml" if path.is_dir() else path


@contextlib.asynccontextmanager
async def build[C: SidecarClient](
    rskill: Path,
    wanted: type[C],
    *,
    name: str = "",
    arbiter: str | None = None,
    allow_noncommercial: bool = False,
) -> AsyncIterator[C]:
    """Give the client of a manifest's sidecar, which serves the socket `name` (default: the
    skill's) while inside.

    `arbiter`: its endpoint; None: the usual one, "none": without leases.

    Raises ManifestError; ConfigError for a kind of model that is not `wanted`, and where another
    model is served; SidecarUnavailable where the sidecar does not start.
    """
    manifest = load_manifest(rskill)
    kind = CLIENTS.get(manifest.kind)
    if kind is None or not issubclass(kind, wanted):
        fitting = [str(known) for known, client in CLIENTS.items() if issubclass(client, wanted)]
        raise ConfigError(
            f"{manifest.name} is a {manifest.kind}, expected a {' or '.join(fitting)}",
            hint=f"see {rskill}",
        )
    name = name or sidecar_name(manifest.name)
    client = kind(program_endpoint(name, os.environ, os.getuid()))
    command = [
        sys.executable,
        "-m",
        "vram_arbiter.sidecars",
        "--name",
        name,
        "--rskill",
        str(rskill),
    ]
    if arbiter is not None:
        command += ["--no-arbiter"] if arbiter == "none" else ["--arbiter", arbiter]
    if allow_noncommercial:
        command.append(LICENSE_FLAG)
    async with served(client, command):
        served_id = client.identity and client.identity.get("rskill")
        if not client.of_field and served_id != manifest.name:
            raise ConfigError(
                f"{client.endpoint} serves {served_id}, not {manifest.name}",
                hint="end that sidecar, or name its endpoint instead of the manifest",
            )
        yield client


@contextlib.asynccontextmanager
async def served(client: SidecarClient, command: Sequence[str]) -> AsyncIterator[None]:
    """While inside, a sidecar serves `client`: the one that listens there, else a child, started by
    `command` without its endpoint.

    Raises SidecarUnavailable where neither answers.
    """
    async with client:
        if is_listening(client.endpoint):
            await client.ping(timeout_s=CONNECT_TIMEOUT_S)
            yield
            return
        child = _Child(client.endpoint, command)
        await child.start()
        try:
            await child.answers(client)
            keeping = asyncio.create_task(child.keep(), name="sidecar")
            try:
                yield
            finally:
                keeping.cancel()
                await asyncio.gather(keeping, return_exceptions=True)
        finally:
            await child.end()


class _Child:
    """One sidecar as a child process; only this one is ever ended. First of all, `start` it."""

    _process: Process

    def __init__(self, endpoint: str, command: Sequence[str]) -> None:
        self._endpoint = endpoint
        self._command = [*command, "--endpoint", endpoint, "--parent", str(os.getpid())]
        self._flags = shlex.join(command[3:])  # behind `python -m vram_arbiter.sidecars`

    async def start(self) -> None:
        """Start it; what it prints goes to stderr. Raises SidecarUnavailable."""
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._command, stdin=DEVNULL, stdout=STDERR, env=os.environ | traces.environ()
            )
        except OSError as error:
            raise SidecarUnavailable(
                f"cannot start {self._command[0]}: {error.strerror}",
                hint="start the sidecar yourself with `vram-sidecar`",
            ) from error

    async def answers(self, client: SidecarClient) -> None:
        """Wait for the first answer. Raises SidecarUnavailable where the child ends before, and no
        other program's sidecar, which was faster, answers either."""
        ended = asyncio.create_task(self._process.wait())
        answered = asyncio.create_task(client.ping(timeout_s=BOOT_S))
        try:
            await asyncio.wait({ended, answered}, return_when=asyncio.FIRST_COMPLETED)
            if answered.done():
                answered.result()
            else:
                answered.cancel()
                await client.ping(timeout_s=PROBE_S)
        except SidecarUnavailable as error:
            if self._process.returncode is None:
                raise
            raise SidecarUnavailable(
                f"the sidecar of {self._endpoint} ended with exit code {self._process.returncode}",
                hint="its reason is on stderr, and "
                f"`vram-sidecar {self._flags} --check` lists what is missing",
            ) from error
        finally:
            ended.cancel()
            answered.cancel()

    async def keep(self) -> None:
        """Start it again after each failure, unless another program's sidecar serves by then."""
        for _ in range(RESTARTS_MAX):
            code = await self._process.wait()
            if code in ENDED or is_listening(self._endpoint):
                log.warning("the sidecar of %s ended with exit code %d", self._endpoint, code)
                return
            log.warning("the sidecar of %s failed (%d) and is started again", self._endpoint, code)
            await asyncio.sleep(RESTART_S)
            try:
                await self.start()
            except SidecarUnavailable as error:
                log.error("%s", error)
                return

    async def end(self) -> None:
        """Send SIGTERM, and SIGKILL after END_S."""
        process = self._process
        if process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), END_S)
        except TimeoutError:
            process.kill()
            await process.wait()
