"""`vram-sidecar`: serve one model. Reads the flags, puts a host together, runs it.

Exit codes: 0 ended in order; 1 could not start or failed, a retry may succeed; 2 flags, files or
environment are wrong: a person has to act.
"""

import argparse
import asyncio
import functools
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.net.server import path_of
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE
from vram_arbiter.schemas.manifest import (
    LICENSE_FLAG,
    LICENSE_HELP,
    ManifestError,
    RSkillManifest,
    load_manifest,
)
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint, program_endpoint
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.commands import command
from vram_arbiter.schemas.runtime.version import add_version
from vram_arbiter.sidecars import environment
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.gpu_passthrough import need_gpu
from vram_arbiter.sidecars.check import Wanted, check, need_packages, need_precision, report
from vram_arbiter.sidecars.doors.open import PACKAGES, Door, door_of
from vram_arbiter.sidecars.model_main import AdapterFor
from vram_arbiter.sidecars.parent import end_with
from vram_arbiter.sidecars.replaced import replaced
from vram_arbiter.sidecars.settings import (
    NICE,
    REQUEST_TIMEOUT_S,
    WAIT_TIMEOUT_S,
    FootprintEntry,
    Settings,
    footprint_for,
    parse_footprint,
    read_footprints,
    read_model,
)
from vram_arbiter.sidecars.weights_keeper import ENVIRONMENT

FOOTPRINTS = "models/footprints.yaml"
_LIMITS = ("min_residency_s", "wait_timeout_s", "request_timeout_s", "idle_release_s")
_SETTINGS = ("name", "gpu", "priority", "standby", "nice", "port", *_LIMITS)
"""Flags that are settings as they are."""


@terminal.program
def main(arguments: list[str] | None = None, adapter_for: AdapterFor = make_adapter) -> int:
    """Run `vram-sidecar` (also `python -m vram_arbiter.sidecars`).

    `adapter_for` lets a program serve a model of its own.
    """
    flags = parser().parse_args(arguments)
    if flags.parent is not None:
        end_with(flags.parent)
    # one service per model, so that a trace shows which one it was
    service = f"vram-sidecar-{flags.name}"
    human = f"%(asctime)s {flags.name} %(levelname)s %(message)s"
    set_up_log = functools.partial(logs.set_up, service, flags.log_level, flags.log_format, human)
    set_up_log()
    try:
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        if adapter_for is make_adapter:
            file = shipped(flags.rskill, "rskills", flags.configs or configs_folder(os.environ))
            environment.enter(load_manifest(file).environment, arguments or sys.argv[1:])
        if flags.check:
            return report(check(wanted_from(flags, adapter_for)), as_json=flags.as_json)
        settings = settings_from(flags)
        manifest = settings.manifest
        if why := manifest.license_refusal(allow_noncommercial=flags.allow_noncommercial):
            raise ConfigError(f"{manifest.name}: {why}")
        adapter_for(manifest, settings.weights)  # refused before anything is served
        if adapter_for is make_adapter:
            need_packages(manifest)
            need_precision(manifest, settings.device)
        from vram_arbiter.sidecars.host import SidecarHost

        about = {telemetry.ATTR_CONSUMER: flags.name}
        # the socket of the imports' server lies beside the sidecar's own (`weights_keeper`): a
        # killed program leaves nothing in the machine's temporary folder
        beside = replaced(tempfile, tempdir=os.path.dirname(path_of(settings.endpoint)))
        with command(service, "serve", serves=True, attributes=about), beside:
            asyncio.run(SidecarHost(settings, adapter_for, set_up_log).serve())
    except VramError as error:
        if flags.as_json:
            print(json.dumps({"error": error.to_wire()}))
        else:
            terminal.complain("vram-sidecar", error)
        return 2 if isinstance(error, (ConfigError, ManifestError)) else 1
    return 0


def settings_from(flags: argparse.Namespace) -> Settings:
    """Return flags, files and environment as settings. Raises ConfigError or ManifestError."""
    wanted = wanted_from(flags, make_adapter)
    manifest, weights = read_model(wanted.rskill, wanted.configs)
    entry, device, endpoint = wanted.footprint(manifest), wanted.device, _endpoint(flags)
    need_gpu(manifest, device)
    if wanted.door is not None:
        wanted.door.check(manifest)
    same = {name: getattr(flags, name) for name in _SETTINGS}
    return Settings(
        **same,
        manifest=manifest,
        weights=weights,
        footprint=entry.on_wire(),
        inference_peak_bytes=entry.inference_peak,
        endpoint=endpoint,
        device=device,
        arbiter=None
        if flags.no_arbiter
        else flags.arbiter or arbiter_endpoint(os.environ, os.getuid()),
        stands_for=entry.stands_for,
        throttle_bytes_per_s=entry.throttle,
        evictable=not flags.pinned,
        door=wanted.door,
    )


def _door(flags: argparse.Namespace) -> Door | None:
    """Return the door that the flags ask for. Raises ConfigError."""
    if flags.door is None:
        if flags.listen or flags.offer or flags.door_keys:
            raise ConfigError("--listen, --offer and --door-keys are for --door", hint="add --door")
        return None
    uid = os.getuid()
    offered = tuple(program_endpoint(name, os.environ, uid) for name in flags.offer)
    return door_of(flags.door, flags.listen, offered, flags.door_keys)


def wanted_from(flags: argparse.Namespace, adapter_for: AdapterFor) -> Wanted:
    """Return the model that the flags name. Raises ConfigError for flags that are wrong."""
    if flags.standby and flags.idle_release_s is not None:
        raise ConfigError(
            "--standby returns by itself and --idle-release-s leaves by itself",
            hint="choose one: --standby for the model that is resident between goals, "
            "--idle-release-s for the models that make room for it",
        )
    if flags.as_json and not flags.check:
        raise ConfigError("--json is for --check", hint="--log-format json is for the log")
    _endpoint(flags)
    configs: Path = flags.configs or configs_folder(os.environ)

    def footprint(manifest: RSkillManifest) -> FootprintEntry:
        if flags.footprint:
            return parse_footprint(flags.footprint)
        path = flags.footprints or configs / FOOTPRINTS
        known = read_footprints(path) if path.exists() or flags.footprints else {}
        return footprint_for(manifest, known)

    return Wanted(
        rskill=shipped(flags.rskill, "rskills", configs),
        configs=configs,
        device=_device(flags.device),
        footprint=footprint,
        allow_noncommercial=flags.allow_noncommercial,
        adapter_for=adapter_for,
        door=_door(flags),
    )


def _endpoint(flags: argparse.Namespace) -> str:
    """Return the endpoint to serve. Raises ConfigError before a model is read."""
    endpoint: str = flags.endpoint or program_endpoint(flags.name, os.environ, os.getuid())
    path_of(endpoint)
    return endpoint


def _device(text: str | None) -> str:
    """Return `--device`, else the simulated GPU of the environment, else the first CUDA GPU.

    Raises ConfigError.
    """
    if text is None:
        folder = os.environ.get(FOLDER_VARIABLE)
        return f"fake:{folder}" if folder else "cuda"
    if re.fullmatch(r"none|cuda(:[0-9]+)?|fake:.+", text):
        return text
    raise ConfigError(
        f"--device {text} is not a device", hint="write fake:FOLDER, cuda, cuda:1 or none"
    )


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vram-sidecar",
        description="Serve one model, under a lease of the VRAM arbiter.",
        epilog="exit codes: 0 ended in order \u00b7 1 could not start or failed, a retry may "
        "succeed \u00b7 2 flags, files or environment are wrong",
    )
    add_version(parser)
    add = parser.add_argument
    add("--name", required=True, type=_name, help="consumer name and socket name, e.g. detector")
    add(
        "--rskill",
        required=True,
        type=Path,
        metavar="FILE",
        help="the skill's rskill.yaml, or the name of a shipped skill",
    )
    add(
        "--device",
        metavar="fake:FOLDER|cuda[:N]|none",
        help=f"default: fake:${FOLDER_VARIABLE} if set, else cuda",
    )
    add("--endpoint", metavar="EP", help="endpoint to serve; default: <runtime folder>/<name>.sock")
    add(
        "--port",
        type=_number(int, 1, 65_535),
        metavar="N",
        help="also serve the endpoint on 127.0.0.1:N, for clients that need a port and users who"
        " may open the socket's file",
    )
    add(
        "--door",
        choices=sorted(PACKAGES),
        help="also serve a policy to clients of another project: lerobot's robot_client, or "
        "openpi_client",
    )
    add("--listen", metavar="127.0.0.1:PORT", help="port of --door")
    add(
        "--offer",
        action="append",
        default=[],
        type=_name,
        metavar="NAME",
        help="another sidecar whose policy lerobot's robots may choose at --door; may be repeated",
    )
    add("--door-keys", type=Path, metavar="FILE", help="API keys of --door openpi, one a line")
    add("--arbiter", metavar="EP", help="default: the arbiter's usual endpoint")
    add("--no-arbiter", action="store_true", help="load at once and stay resident, without a lease")
    add("--configs", type=Path, metavar="DIR", help="folder of local:// weights")
    add(
        "--footprints",
        type=Path,
        metavar="FILE",
        help=f"default: {FOOTPRINTS} in the configs folder",
    )
    add(
        "--footprint",
        metavar="PEAK[,STEADY[,RESIDUE[,INFERENCE_PEAK]]]",
        help="instead of the file, e.g. 5.3GB,5.3GB,450MiB,6GB",
    )
    add(
        "--gpu",
        metavar="UUID|INDEX|any",
        help="GPU to lease; default: the simulated one, else any",
    )
    add(
        "--priority",
        type=_number(int, 0, d.PRIORITY_MAX),
        default=d.PRIORITY,
        help="0..100, default %(default)s",
    )
    add("--pinned", action="store_true", help="never evicted")
    add(
        "--min-residency-s",
        type=_number(float, 0, 86_400),
        default=d.MIN_RESIDENCY_S,
        help="default %(default)s",
    )
    add(
        "--wait-timeout-s",
        type=_number(float, 0.1, 86_400),
        default=WAIT_TIMEOUT_S,
        help="limit of a request's wait for the lease; default %(default)s",
    )
    add(
        "--request-timeout-s",
        type=_number(float, 0.1, 86_400),
        default=REQUEST_TIMEOUT_S,
        help="limit of one request's work in the model, after which its process is ended; "
        "default %(default)s",
    )
    add(
        "--idle-release-s",
        type=_number(float, 0.1, 86_400),
        help="release a model that no request and no goal has used for this long, so that one on "
        "standby returns; default: never",
    )
    add(
        "--standby",
        action="store_true",
        help="once evicted, load again when there is room and no request waits; its return "
        "evicts no model, so give the model that it leaves for "
        "(a policy) --idle-release-s",
    )
    add(
        "--nice",
        type=_number(int, 0, 19),
        default=NICE,
        help="nice value of the process that loads and runs the model; default %(default)s",
    )
    add("--parent", type=int, metavar="PID", help="end with this process, which starts the sidecar")
    add("--log-level", choices=("debug", "info", "warning", "error"), default="info")
    add("--log-format", choices=logs.FORMS, default="human", help="json: one object a line")
    add(
        "--check",
        action="store_true",
        help="load nothing: check license, family, packages, weights, precision, footprint and GPU",
    )
    add("--json", dest="as_json", action="store_true", help="print the findings of --check as JSON")
    add(LICENSE_FLAG, action="store_true", help=LICENSE_HELP)
    return parser


def _name(text: str) -> str:
    """Return a valid name: a consumer for the arbiter, and a file name in the runtime folder."""
    if not text or not text.isprintable() or "/" in text or len(text) > d.NAME_MAX_CHARS:
        raise argparse.ArgumentTypeError(
            f"must be 1 to {d.NAME_MAX_CHARS} characters that can be printed, without /"
        )
    return text


def _number[T: (int, float)](kind: type[T], low: float, high: float) -> Callable[[str], T]:
    def read(text: str) -> T:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be {low:g} to {high:g}")
        return value

    return read


if __name__ == "__main__":
    sys.exit(main())
