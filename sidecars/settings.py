"""Settings of one sidecar: its model, its bytes, its endpoints.

Put together from a manifest, the footprint file and flags.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    RootModel,
    ValidationError,
    model_validator,
)

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import problems_of
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.units import ByteSize
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.schemas.yamltext import read_yaml, validated
from vram_arbiter.sidecars.doors.open import Door
from vram_arbiter.sidecars.weights import Weights, resolve, with_processors

NICE_VARIABLE = "VRAM_ARBITER_SIDECAR_NICE"
HOST_VARIABLE = "VRAM_ARBITER_SIDECAR_HOST"
"""Tell the server of imports its nice value and the pid of its host (`preload`)."""
NICE = 5  # a third of the cores' time beside one ordinary program, all of it on idle cores
WAIT_TIMEOUT_S = 120.0  # wait for the lease of a request without a time limit of its own
# limit of work in the model; the field's clients wait as long for an answer
REQUEST_TIMEOUT_S = 180.0
GB = 10**9  # manifests count in 1000s
DECLARED: Final = "min_vram_gb says"
"""Source of a footprint that nobody measured: the manifest's own word."""
_KEY = re.compile(rf"[^/\s]+/[^/\s]+(/({'|'.join(Dtype)}))?")
"""Key of a footprint: a model, or a model in one number format."""


class FootprintEntry(BaseModel):
    """One entry of `configs/models/footprints.yaml`.

    `inference_peak` is the most that the process takes while it answers (weights, context and
    activations), 0 where it was never measured.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    stands_for: str = ""
    load_peak: ByteSize
    steady: ByteSize
    residue: ByteSize = d.RESIDUE_BYTES
    inference_peak: ByteSize = 0
    throttle: Annotated[ByteSize, Field(gt=0)] | None = None
    source: str = ""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.residue <= self.steady <= self.load_peak:
            raise ValueError("must be residue ≤ steady ≤ load_peak: each includes the context")
        if 0 < self.inference_peak < self.steady:
            raise ValueError("must be steady ≤ inference_peak: it includes the resident weights")
        return self

    def on_wire(self) -> Footprint:
        return Footprint(
            load_peak_bytes=self.load_peak, steady_bytes=self.steady, residue_bytes=self.residue
        )


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a sidecar's host. `arbiter` None: without one, resident from the start."""

    name: str
    manifest: RSkillManifest
    weights: Weights
    footprint: Footprint
    endpoint: str
    device: str  # fake:FOLDER | cuda[:N] | none
    arbiter: str | None
    inference_peak_bytes: int = 0  # most while it answers; 0: not known
    stands_for: str = ""  # the production model of the simulated footprint
    throttle_bytes_per_s: int | None = None
    gpu: str | None = None  # to lease; None: the device's own
    priority: int = d.PRIORITY
    evictable: bool = True
    min_residency_s: float = d.MIN_RESIDENCY_S
    wait_timeout_s: float = WAIT_TIMEOUT_S
    # a model that works longer is stuck, and its process is ended
    request_timeout_s: float = REQUEST_TIMEOUT_S
    nice: int = NICE
    idle_release_s: float | None = None  # None: resident until another request needs the room
    standby: bool = False  # once evicted, it returns when there is room
    port: int | None = None  # of 127.0.0.1, in front of the endpoint
    door: Door | None = None

    @property
    def revision(self) -> str:
        return self.manifest.weights_revision or self.manifest.version

    def steady_charge(self, resident_bytes: int) -> int:
        """Return what the lease is charged while the model is resident.

        That covers the inference peak: activations come and go within one answer, between two
        readings of the GPU. Charged for its weights alone, a model would share the GPU with another
        one until both answer at the same time, and one of them fails with `oom`.
        """
        return max(resident_bytes, self.inference_peak_bytes)

    def lease_spec(self, park_bytes: int = 0) -> LeaseSpec:
        """Return the spec of a lease. `park_bytes`: host RAM of its weights while it is parked.

        Nothing is retained on the GPU after an unload: the model's process ends, and its context
        too.
        """
        footprint = lease_footprint(self.footprint, self.inference_peak_bytes)
        return LeaseSpec(
            consumer=self.name,
            model_id=self.manifest.name,
            revision=self.revision,
            gpu=self.gpu or "any",
            footprint=footprint,
            priority=self.priority,
            evictable=self.evictable,
            min_residency_s=self.min_residency_s,
            standby=self.standby,
            park_bytes=park_bytes,
        )


def lease_footprint(footprint: Footprint, inference_peak_bytes: int) -> Footprint:
    """Return what a lease is charged for a model that takes `footprint` (`Settings.lease_spec`)."""
    steady = max(footprint.steady_bytes, inference_peak_bytes)
    peak = max(footprint.load_peak_bytes, steady)
    return Footprint(load_peak_bytes=peak, steady_bytes=steady, residue_bytes=0)


def read_model(rskill: Path, configs: Path) -> tuple[RSkillManifest, Weights]:
    """Return the manifest and its weights. Raises ManifestError or ConfigError."""
    manifest = load_manifest(rskill)
    if manifest.weights_uri is None:
        raise ConfigError(
            f"{rskill}: {manifest.name} has no weights",
            hint="sidecars serve detector, vlm, vla and reward skills",
        )
    weights = resolve(manifest.weights_uri, configs)
    return manifest, with_processors(weights, manifest, configs)


def _model(key: str) -> str:
    if not _KEY.fullmatch(key):
        raise ValueError(
            "names no model: write OWNER/NAME or OWNER/NAME/DTYPE, DTYPE one of " + ", ".join(Dtype)
        )
    return key


class _Footprints(RootModel[dict[Annotated[str, AfterValidator(_model)], FootprintEntry]]):
    pass


def read_footprints(path: Path) -> dict[str, FootprintEntry]:
    """Read all entries of a footprint file. Raises ConfigError with every mistake and its line."""
    return validated(_Footprints, read_yaml(path)).root


def parse_footprint(text: str) -> FootprintEntry:
    """Parse the flag `--footprint`: `PEAK[,STEADY[,RESIDUE[,INFERENCE_PEAK]]]`, each a size.

    Raises ConfigError.
    """
    hint = "write PEAK,STEADY,RESIDUE,INFERENCE_PEAK, e.g. 5.3GB,5.3GB,450MiB,6GB"
    names = ("load_peak", "steady", "residue", "inference_peak")
    sizes = text.split(",")
    given = dict(zip(names, sizes, strict=False))
    if len(sizes) > len(names):
        raise ConfigError(f"--footprint {text}: at most {len(names)} sizes", hint=hint)
    try:
        return FootprintEntry.model_validate({"steady": sizes[0], **given})
    except ValidationError as error:
        problem = problems_of(error, FootprintEntry, given)[0]
        raise ConfigError(f"--footprint {text}: {problem.message}", hint=hint) from None


def footprint_for(
    manifest: RSkillManifest, entries: Mapping[str, FootprintEntry]
) -> FootprintEntry:
    """Return the footprint of a manifest: the entry of its model in its number format, by the
    manifest's name, the repository of its weights or the one that these were made from, else the
    entry of its name, else the bytes that it declares.

    Measured bytes go before declared ones: the field declares 2.5 GB where 3.3 are resident. Raises
    ConfigError if none exists.
    """
    sources = (manifest.name, *map(_repository, (manifest.weights_uri, manifest.source_repo)))
    dtype = manifest.quantization.dtype
    for key in (*(f"{source}/{dtype}" for source in sources if source), manifest.name):
        if entry := entries.get(key):
            return entry
    if manifest.declared_vram_gb is None:
        raise ConfigError(
            f"no footprint is known for {manifest.name} in {dtype}",
            hint="measure it with `vramctl calibrate`, add it to configs/models/footprints.yaml, "
            "declare min_vram_gb for its dtype, or pass --footprint",
        )
    declared = round(manifest.declared_vram_gb * GB)
    return FootprintEntry(
        load_peak=declared,
        steady=declared,
        residue=min(declared, d.RESIDUE_BYTES),
        source=DECLARED,
    )


def _repository(uri: str | None) -> str:
    """Return OWNER/REPO of an address of the hub, else an empty text."""
    scheme, _, rest = (uri or "").partition("://")
    return rest.partition("@")[0] if scheme == "hf" else ""
