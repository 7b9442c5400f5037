"""`vram-sidecar --check`: what keeps a model from being served, before anything is loaded.

All findings are collected, not only the first. No weights are downloaded, no GPU is used, and the
model is built without bytes (`load("meta")`).
"""

import contextlib
import importlib.util
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from vram_arbiter.schemas.defaults import RESERVE_BYTES
from vram_arbiter.schemas.errors import ConfigError, NoGpu, UnsupportedQuantization, VramError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.sidecars.adapters import policy_families
from vram_arbiter.sidecars.adapters.base import ModelAdapter, has_model
from vram_arbiter.sidecars.adapters.choose import ONNX
from vram_arbiter.sidecars.adapters.gpu_passthrough import need_gpu
from vram_arbiter.sidecars.adapters.onnx_detector import providers
from vram_arbiter.sidecars.device.capacity import capacities
from vram_arbiter.sidecars.doors.open import Door
from vram_arbiter.sidecars.model_main import AdapterFor
from vram_arbiter.sidecars.quantization import check_precision
from vram_arbiter.sidecars.replaced import replaced
from vram_arbiter.sidecars.settings import DECLARED, FootprintEntry, lease_footprint, read_model
from vram_arbiter.sidecars.weights import Weights, cached

NOT_COMPARED = "not compared with the model"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. `ok` None: not checked, or worth knowing. `retry`: time may mend it."""

    what: str
    ok: bool | None
    says: str
    retry: bool = False


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be served. `footprint` raises ConfigError if none is known."""

    rskill: Path
    configs: Path
    device: str  # fake:FOLDER | cuda[:N] | none
    footprint: Callable[[RSkillManifest], FootprintEntry]
    allow_noncommercial: bool
    adapter_for: AdapterFor
    door: Door | None = None


def check(wanted: Wanted) -> list[Finding]:
    """Return all findings about one model. Raises ManifestError for a manifest that is wrong."""
    manifest = load_manifest(wanted.rskill)
    findings = [
        Finding("manifest", True, f"{manifest.name} {manifest.version}, a {manifest.kind}"),
        _license(manifest, wanted.allow_noncommercial),
    ]
    weights: Weights | None = None
    try:
        _, weights = read_model(wanted.rskill, wanted.configs)
    except ConfigError as error:
        findings.append(_bad("weights", error))
    adapter: ModelAdapter | None = None
    served = f"served as {manifest.kind} {manifest.model_family or ''}".rstrip()
    family, refused = Finding("family", True, served), None
    try:
        adapter = wanted.adapter_for(manifest, weights or Weights(manifest.weights_uri or ""))
    except UnsupportedQuantization as error:
        refused = error
    except VramError as error:
        family = _bad("family", error)
    findings.append(family)
    if (door := wanted.door) is not None:
        findings.append(
            _checked("door", f"{door.protocol}, port {door.port}", door.check, manifest)
        )
    if manifest.weights_uri is None:
        return findings  # nothing to load: no bytes
    packages = _checked("packages", "installed", need_packages, manifest)
    precision = (
        _checked("precision", manifest.quantization.dtype, need_precision, manifest, wanted.device)
        if refused is None
        else _bad("precision", refused)
    )
    findings += [packages, precision]
    comparable = adapter is not None and packages.ok and precision.ok
    findings += _weights(manifest, weights, wanted.adapter_for if comparable else None)
    return findings + _bytes(manifest, wanted)


def report(findings: Sequence[Finding], *, as_json: bool) -> int:
    """Print the findings. Return the exit code: 0, 1 if time may mend them, 2 if a person must."""
    bad = [finding for finding in findings if finding.ok is False]
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        marks = {True: "ok  ", False: "BAD ", None: "    "}
        for finding in findings:
            print(printable(f"{marks[finding.ok]} {finding.what:<10} {finding.says}"))
        names = ", ".join(dict.fromkeys(finding.what for finding in bad))
        print(f"not ok: {names}" if bad else "ok")
    if not bad:
        return 0
    return 1 if all(finding.retry for finding in bad) else 2


def _bad(what: str, error: VramError) -> Finding:
    return Finding(what, False, str(error), retry=isinstance(error, NoGpu))


def _checked[*A](what: str, says: str, need: Callable[[*A], None], *given: *A) -> Finding:
    """Return the finding of a check that raises its refusal."""
    try:
        need(*given)
    except VramError as error:
        return _bad(what, error)
    return Finding(what, True, says)


def _license(manifest: RSkillManifest, allow_noncommercial: bool) -> Finding:
    if why := manifest.license_refusal(allow_noncommercial=allow_noncommercial):
        return Finding("license", False, why)
    return Finding("license", True, str(manifest.license))


def need_packages(manifest: RSkillManifest) -> None:
    """Raise ConfigError where the model's libraries are not installed."""
    if manifest.runtime in ONNX:
        need(f"runtime {manifest.runtime.value}", "onnxruntime", "PIL", extra="onnx")
    elif has_model(manifest):
        lerobot = manifest.kind in (Kind.VLA, Kind.REWARD)
        library = "lerobot" if lerobot else "transformers"
        need(f"a model of kind {manifest.kind}", "torch", library, extra="sidecars")
        policy_families.need_packages(manifest)


def need_precision(manifest: RSkillManifest, device: str) -> None:
    """Raise UnsupportedQuantization where the model cannot be run in its number format, ConfigError
    where ONNX Runtime cannot run it on the device."""
    if manifest.runtime in ONNX:
        providers(manifest, device)
    elif has_model(manifest):
        check_precision(manifest, device)


def _weights(
    manifest: RSkillManifest, weights: Weights | None, adapter_for: AdapterFor | None
) -> list[Finding]:
    """Compare the checkpoint with the model that its config describes. Without an adapter, say only
    whether it is here."""
    if weights is None:
        return []
    if not has_model(manifest):
        return [Finding("weights", True, "it has none")]
    if importlib.util.find_spec("huggingface_hub") is None and not weights.local:
        return [Finding("weights", None, f"{NOT_COMPARED}: the hub's package is not installed")]
    place = weights if weights.local else cached(weights)
    if place is None:
        at = f" --revision {weights.revision}" if weights.revision else ""
        says = f"weights are not here: `hf download {weights.source}{at}` fetches them"
        return [Finding("weights", False, says)]
    if adapter_for is None:
        return [Finding("weights", None, f"{NOT_COMPARED}: see above")]
    try:
        from huggingface_hub import constants

        offline = replaced(constants, HF_HUB_OFFLINE=True)  # nothing is downloaded
        # what the loaders print is not the answer
        with contextlib.redirect_stdout(sys.stderr), offline:
            adapter = adapter_for(manifest, place)
            adapter.prepare()
            adapter.load("meta")
    except ImportError as error:
        hint = "pip install 'vram-arbiter[sidecars]'"
        return [Finding("packages", False, f"{error} ({hint})")]
    except UnsupportedQuantization as error:
        return [_bad("precision", error)]
    except VramError as error:
        lacks = isinstance(error.__cause__, ImportError)
        return [_bad("packages" if lacks else "weights", error)]
    # any failure of a model's code is a finding
    except Exception as error:  # noqa: BLE001
        return [Finding("weights", False, f"{type(error).__name__}: {error}")]
    whole = Finding("weights", True, f"{place.source} holds the whole model")
    return [whole, *_features(adapter)]


def _features(adapter: ModelAdapter) -> list[Finding]:
    """Compare a policy's cameras and vectors, as the manifest has them, with the checkpoint's."""
    from vram_arbiter.sidecars.adapters.policy import PolicyAdapter

    if not isinstance(adapter, PolicyAdapter):
        return []
    wrong = adapter.misfits()
    says = "; ".join(wrong) or "cameras, state and action are the checkpoint's"
    return [Finding("features", not wrong, says)]


def _bytes(manifest: RSkillManifest, wanted: Wanted) -> list[Finding]:
    """Compare the lease with the GPU's capacity less what the arbiter keeps free by default."""
    findings, needed = [], None
    try:
        entry = wanted.footprint(manifest)
        lease = lease_footprint(entry.on_wire(), entry.inference_peak)
        needed = lease.load_peak_bytes
        says = (
            f"load peak {format_bytes(needed)}, charged {format_bytes(lease.steady_bytes)} "
            f"while resident{', as ' + DECLARED if entry.source == DECLARED else ''}"
        )
        findings.append(Finding("footprint", True, says))
    except ConfigError as error:
        findings.append(_bad("footprint", error))
    if wanted.device == "none":
        gpu = _checked("gpu", "not checked: --device none", need_gpu, manifest, wanted.device)
        return [*findings, replace(gpu, ok=None) if gpu.ok else gpu]
    try:
        found = capacities(wanted.device)
    except (NoGpu, ConfigError) as error:
        return [*findings, _bad("gpu", error)]
    uuid, most = max(found.items(), key=lambda item: item[1])
    has = f"{uuid} has {format_bytes(most)}"
    if needed is None:
        return [*findings, Finding("gpu", None, f"not compared: no footprint; {has}")]
    room = most - RESERVE_BYTES
    fits = needed <= room
    says = f"{has}, {format_bytes(RESERVE_BYTES)} of it reserved: " + (
        "it fits" if fits else f"{format_bytes(needed - room)} too small"
    )
    return [*findings, Finding("gpu", fits, says)]
