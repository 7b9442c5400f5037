"""`vramctl doctor`: is this installation what it should be? Looks and says; changes nothing."""

import importlib.util
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clients.cli import quick
from schemas.endpoints import arbiter_endpoint

PACKAGES = ("arbiter", "clients", "sidecars", "runner", "reasoner", "schemas")


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. `ok` None: worth knowing, not wrong."""

    what: str
    ok: bool | None
    says: str


def doctor(*, as_json: bool, endpoint: str | None) -> int:
    """3 if the arbiter cannot be reached, 1 if anything else is wrong, else 0."""
    where = endpoint or arbiter_endpoint(os.environ, os.getuid())
    findings = [*_origins(), _driver(), Finding("endpoint", None, where)]
    reachable, about = _arbiter(where)
    findings += about
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        marks = {True: "ok  ", False: "BAD ", None: "    "}
        for finding in findings:
            print(f"{marks[finding.ok]} {finding.what:<18} {finding.says}")
    if not reachable:
        return quick.UNREACHABLE
    return quick.NO if any(finding.ok is False for finding in findings) else quick.OK


def _origins() -> list[Finding]:
    """All six names must come from one tree: generic names can be shadowed by other distributions."""
    origins = {name: _origin(name) for name in PACKAGES}
    home = origins["clients"].parent if origins["clients"] else None
    findings = []
    for name, folder in origins.items():
        if folder is None:
            findings.append(Finding(name, False, "not importable: reinstall vram-arbiter"))
        else:
            foreign = "" if folder.parent == home else f" (another tree than clients: {home})"
            findings.append(Finding(name, not foreign, f"{folder}{foreign}"))
    return findings


def _origin(name: str) -> Path | None:
    spec = importlib.util.find_spec(name)
    locations = list(spec.submodule_search_locations or ()) if spec else []
    return Path(locations[0]).resolve() if locations else None


def _driver() -> Finding:
    import pynvml

    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        return Finding("nvidia driver", None, f"{error}; `vram-arbiter --gpu fake:8GiB` simulates a card")
    try:
        cards = pynvml.nvmlDeviceGetCount()
        first = pynvml.nvmlDeviceGetHandleByIndex(0) if cards else None
        said = f"{pynvml.nvmlSystemGetDriverVersion()}, {cards} cards"
        return Finding("nvidia driver", True, said + _memory_of(pynvml, first))
    finally:
        pynvml.nvmlShutdown()


def _memory_of(nvml: Any, card: Any) -> str:
    """Jetson and GB10 have no memory of their own: the arbiter's source `auto` reads the machine's there."""
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
        status = quick.ask("status", {}, endpoint)
    except quick.Unreachable as error:
        return False, [Finding("daemon", False, f"{error} ({error.hint})")]
    if not status.get("ok"):
        return True, [Finding("daemon", False, str(status["error"]["message"]))]
    about = [
        Finding("daemon", True, f"{status['phase']}, epoch {status['epoch']}, {status['clients']} clients")
    ]
    return True, about + [_card(gpu) for gpu in status["gpus"]]


def _card(gpu: dict[str, Any]) -> Finding:
    what = f"gpu {gpu['index']}"
    if gpu["measured_used_bytes"] is None:
        return Finding(
            what, False, f"{gpu['name']}: the probe does not answer, nothing is granted ({gpu['blocked']})"
        )
    if gpu["blocked"]:
        return Finding(what, None, f"{gpu['name']}: no grants now: {gpu['blocked']}")
    reads = {"unified": "memory shared with the CPU, read from /proc/meminfo", "fake": "a simulated card"}
    source = gpu.get("source") or "?"
    return Finding(what, True, f"{gpu['name']}, its probe answers ({reads.get(source, source)})")
