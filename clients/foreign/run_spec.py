"""What `vramctl run` is told of a program, and the lease that it means."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from vram_arbiter.clients.foreign.actions import Action
from vram_arbiter.clients.foreign.control import Control
from vram_arbiter.clients.foreign.service import Service
from vram_arbiter.schemas.defaults import MIN_RESIDENCY_S, NAME_MAX_CHARS, RESIDUE_BYTES
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

type OnRevoke = Literal["priority", "term", "pin"]


class Recorder(Protocol):
    """Keeps a program's bytes while it runs (`clients.calibration.record`)."""

    def begin(self) -> None: ...

    def end(self) -> None: ...


@dataclass(frozen=True, slots=True)
class RunSpec:
    """What to run and what it needs.

    `grace_s`: time from SIGTERM to SIGKILL, or for requests in progress; None: as long as it
    takes. `restarts`: the program is ended to make room, and started again. `action`: it is made
    to free instead, and keeps `park_bytes` of host RAM meanwhile. With neither, its end is the end.
    `limit_s`: the program is ended after this time, which is no failure. `record`: the program's
    bytes are recorded, and what it prints goes to stderr. `health`: URL that answers 200 once it
    can serve, `start_s` after its start at the latest; until then it loads. `control`: another
    program says when it is wanted: evicted, it does not return by itself. `service`: what runs in
    place of `command`, which has its name.
    """

    command: list[str]
    name: str | None
    vram_bytes: int
    gpu: str
    priority: int
    wait_timeout_s: float | None
    exclusive: bool
    on_revoke: OnRevoke
    grace_s: float | None
    restarts: bool = False
    action: Action | None = None
    park_bytes: int = 0
    environ: Mapping[str, str] = field(default_factory=dict)
    limit_s: float | None = None
    record: Recorder | None = None
    health: str = ""
    start_s: float | None = None
    min_residency_s: float = MIN_RESIDENCY_S
    control: Control | None = None
    service: Service | None = None

    @property
    def consumer(self) -> str:
        """`--name`, or the program's, which may hold any byte and be of any length."""
        return self.name or printable(Path(self.command[0]).name)[:NAME_MAX_CHARS] or "program"

    @property
    def comes_back(self) -> bool:
        return self.restarts or self.action is not None

    @property
    def tends_orphans(self) -> bool:
        """Whether processes that outlive the program are ended: its successor needs their room."""
        return self.service is None and (self.comes_back or self.control is not None)


def lease_spec(spec: RunSpec) -> LeaseSpec:
    """Return the program's whole need for its whole life: nothing is known of phases inside it."""
    keeps_context = spec.action is not None and spec.action.keeps_context
    return LeaseSpec(
        consumer=spec.consumer,
        model_id=spec.consumer,
        gpu=spec.gpu,
        mode="exclusive" if spec.exclusive else "shared",
        footprint=Footprint(
            load_peak_bytes=spec.vram_bytes,
            steady_bytes=spec.vram_bytes,
            residue_bytes=min(RESIDUE_BYTES, spec.vram_bytes) if keeps_context else 0,
        ),
        priority=spec.priority,
        evictable=spec.on_revoke != "pin",
        min_residency_s=spec.min_residency_s,
        standby=spec.comes_back and spec.control is None,
        park_bytes=spec.park_bytes,
        cgroup=None if spec.service is None else spec.service.cgroup,
    )
