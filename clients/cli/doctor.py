"""`vramctl doctor`: checks the installation, the daemon and its GPUs, and changes nothing."""

import argparse
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import vram_arbiter
from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.replies import NO, OK, UNREACHABLE
from vram_arbiter.clients.net import request
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version
from vram_arbiter.schemas.sizes import format_bytes

DESCRIPTIONS = {
    "doctor": "Check this installation: where it lies, the endpoint, the daemon's health, its "
    "GPUs. Exits 0 if all is well, 1 on any finding (a journal that cannot be written, a drained "
    "daemon, a GPU that cannot be read or is under pressure), 3 if the arbiter cannot be reached."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    return doctor(as_json=args.as_json, endpoint=args.endpoint)


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. `ok` None: worth knowing, not wrong."""

    what: str
    ok: bool | None
    says: str


def doctor(*, as_json: bool, endpoint: str | None) -> int:
    """Return 0 if all is well, 1 for a finding (an unhealthy daemon too), 3 if the arbiter cannot
    be reached."""
    where = endpoint or arbiter_endpoint(os.environ, os.getuid())
    findings = [_origin(), _driver(), Finding("endpoint", None, where)]
    reachable, about = _arbiter(where)
    findings += about
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        marks = {True: "ok  ", False: "BAD ", None: "    "}
        for finding in findings:
            print(printable(f"{marks[finding.ok]} {finding.what:<18} {finding.says}"))
    if not reachable:
        return UNREACHABLE
    return NO if any(finding.ok is False for finding in findings) else OK


def _origin() -> Finding:
    """Return the folder that the product is imported from, and its version."""
    return Finding("installation", True, f"{Path(vram_arbiter.__file__).parent} ({version()})")


def _driver() -> Finding:
    import pynvml

    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        return Finding(
            "nvidia driver", None, f"{error}; `vram-arbiter --gpu fake:8GiB` simulates a card"
        )
    try:
        cards = pynvml.nvmlDeviceGetCount()
        first = pynvml.nvmlDeviceGetHandleByIndex(0) if cards else None
        said = f"{pynvml.nvmlSystemGetDriverVersion()}, {cards} cards"
        return Finding("nvidia driver", True, said + _memory_of(pynvml, first))
    finally:
        pynvml.nvmlShutdown()


def _memory_of(nvml: Any, card: Any) -> str:
    """Jetson and GB10 have no memory of their own: the arbiter's source `auto` reads the machine's
    there."""
    if card is None:
        return ""
    try:
        nvml.nvmlDeviceGetMemoryInfo(card)
    except nvml.NVMLError_NotSupported:
        return "; without memory of its own (source unified)"
    except nvml.NVMLError as error:
        return f"; its memory cannot be read: {error}"
    return ""


def _arbiter(endpoint: str) -> tuple[bool, list[Finding]]:
    try:
        status = request.ask("status", {}, endpoint)
    except request.Unreachable as error:
        return False, [Finding("daemon", False, f"{error} ({error.hint})")]
    if not status.get("ok"):
        return True, [Finding("daemon", False, str(status["error"]["message"]))]
    about = [
        Finding(
            "daemon",
            True,
            f"{status['phase']}, epoch {status['epoch']}, {status['clients']} clients",
        )
    ]
    about += [Finding("files", False, problem) for problem in status.get("problems", ())]
    if status.get("drained"):
        about.append(
            Finding(
                "grants",
                False,
                f"drained by {status['drained']}: grant again with `vramctl resume`",
            )
        )
    return True, about + [_card(gpu) for gpu in status["gpus"]]


def _card(gpu: JsonObject) -> Finding:
    what = f"gpu {gpu['index']}"
    if gpu["measured_used_bytes"] is None:
        return Finding(
            what,
            False,
            f"{gpu['name']}: the probe does not answer, nothing is granted "
            f"({(gpu['blocked'] or {}).get('text', '')})",
        )
    if gpu["pressure_bytes"]:
        over = format_bytes(gpu["pressure_bytes"])
        return Finding(what, False, f"{gpu['name']}: {over} more are held than were granted")
    if gpu["blocked"] is not None:
        return Finding(what, None, f"{gpu['name']}: no grants now: {gpu['blocked']['text']}")
    reads = {
        "unified": "memory shared with the CPU, read from /proc/meminfo",
        "fake": "a simulated card",
    }
    source = gpu.get("source") or "?"
    return Finding(what, True, f"{gpu['name']}, its probe answers ({reads.get(source, source)})")
