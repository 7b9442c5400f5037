"""What a record of the journal may say: types and ranges of what `Core.record_lease` and its
neighbors write.

A record outside of them would end every start in a traceback, or every answer of the daemon: a pid
that no kernel gives, a token that no wire carries. Unknown fields pass, within the limits of
`schemas.strictjson`: an engine may write more than is read here.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vram_arbiter.schemas import defaults as d

Pid = Annotated[int, Field(ge=1, le=1 << 30)]
Ticks = Annotated[int, Field(ge=0, lt=1 << 62)]
Count = Annotated[int, Field(ge=0, lt=1 << 62)]
Bytes = Annotated[int, Field(ge=0, le=1 << 53)]
Text = Annotated[str, Field(max_length=4 * d.REASON_MAX_CHARS)]
Id = Annotated[str, Field(min_length=1, max_length=d.NAME_MAX_CHARS)]
Seconds = Annotated[float, Field(ge=0, le=1e10, allow_inf_nan=False)]
Order = tuple[Text, Text]


class _Record(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Spec(_Record):
    consumer: Id
    model_id: Id
    revision: Text
    gpu: Id
    exclusive: bool
    load_peak_bytes: Bytes
    steady_bytes: Bytes
    residue_bytes: Bytes
    priority: Annotated[int, Field(ge=0, le=d.PRIORITY_MAX)]
    evictable: bool
    ttl_s: Annotated[Seconds, Field(gt=0)]
    min_residency_s: Seconds
    deny_on_deadline: bool
    standby: bool = False
    on_overstay: Literal["wait", "terminate", "kill"] = "wait"
    park_bytes: Bytes = 0
    independent: bool = False
    gang: tuple[Id, Annotated[int, Field(ge=2, le=16)]] | None = None


class LeaseRecord(_Record):
    lease_id: Id
    token: tuple[Count, Count]
    state: Literal[
        "loading", "held", "revoking", "unloading", "verifying", "parked", "standby", "debt"
    ]
    gpu: Id | None
    pid: Pid
    start_ticks: Ticks
    nonce: Id
    charge_bytes: Bytes
    load_peak_bytes: Bytes
    measured_bytes: Bytes | None
    exiting: bool
    gang: tuple[Id, Annotated[int, Field(ge=1, le=16)]] | None = None
    pinned: Order | None = None
    comes_back: bool = False
    parks: bool = False
    parked_bytes: Bytes = 0
    left_for: Text = ""
    dismissed: bool = False
    held_from: Seconds = 0.0  # on the monotonic clock
    users: Annotated[list[tuple[Pid, Ticks, Id, Text]], Field(max_length=1 << 17)] = []
    spec: _Spec


class ResidueRecord(_Record):
    pid: Pid
    start_ticks: Ticks
    gpu: Id
    residue_bytes: Bytes
    floor_bytes: Bytes = 0


class DrainRecord(_Record):
    by: Text
    reason: Text


class DoubtRecord(_Record):
    why: str


def check_record(key: str, text: str) -> None:
    """Raises ValueError that says what is wrong with the record of `key`, in one line."""
    model: type[BaseModel]
    if key.startswith("lease:"):
        model = LeaseRecord
    elif key.startswith("residue:"):
        model = ResidueRecord
    elif key in ("drain", "doubt"):
        model = DrainRecord if key == "drain" else DoubtRecord
    else:
        raise ValueError("no part of the daemon writes such a record")
    try:
        found: Any = model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{where}: {first['msg']}" if where else first["msg"]) from None
    if isinstance(found, LeaseRecord) and key != f"lease:{found.lease_id}":
        raise ValueError(f"lease_id: it is the record of {found.lease_id}")
