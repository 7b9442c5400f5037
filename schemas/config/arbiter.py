"""The arbiter's configuration: one model, one YAML file, every key with purpose, default and range.

Pure: `load_config(text, name)` takes the text of a file; the daemon reads the file.
`configs/arbiter.yaml` states the same keys with the same defaults, and a test holds both together.
No key is required: an empty file is the default configuration.
"""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.runtime.endpoints import check_endpoint
from vram_arbiter.schemas.units import ByteSize, parse_bytes

Seconds = Annotated[float, Field(gt=0, le=86_400)]
Share = Annotated[float, Field(gt=0, le=1)]


class _Section(BaseModel):
    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        use_attribute_docstrings=True,
        allow_inf_nan=False,
        defer_build=True,  # sections are validated as parts of the whole
    )


class GpuConfig(_Section):
    """Which GPUs are leased and how much of each."""

    source: str = "auto"
    """`auto`: `nvml` or `unified`, by what this machine is. `nvml`: its NVIDIA GPUs and MIG
    instances. `unified`: the memory that CPU and GPU share on a Jetson or a GB10. `drm`: its AMD
    and Intel GPUs. `fake:8GiB`: one simulated GPU. `fake:FOLDER`: the GPU in that folder.
    """
    reserve_bytes: ByteSize = d.RESERVE_BYTES
    """Bytes of every GPU that are never leased: driver, display, allocator slack. At least 15 % of
    a memory shared with the CPU."""
    capacity_bytes: dict[str, ByteSize] = Field(default_factory=dict)
    """Cap per GPU, by UUID or index as text: lease out less than the GPU has. A GPU that is not
    named has no cap."""

    pids: Literal["auto", "own", "host"] = "auto"
    """Pid namespace in which the driver counts. `auto`: this one on a host, the host's in a
    container."""
    host_proc: Annotated[str, Field(pattern="^/")] | None = None
    """In a container: where the host's /proc is mounted, so that the driver's pids can be told
    apart. Null: lists are no evidence there."""

    @field_validator("source")
    @classmethod
    def _known_source(cls, value: str) -> str:
        if value not in ("auto", "nvml", "unified", "drm") and not (
            value.startswith("fake:") and len(value) > 5
        ):
            raise ValueError(
                f"{value!r} is not a source of GPUs; write auto, nvml, unified, drm, fake:8GiB or "
                "fake:FOLDER"
            )
        sizes = (
            value.removeprefix("fake:") if value.startswith("fake:") and "/" not in value else ""
        )
        if sizes and not all(parse_bytes(size) for size in sizes.split(",")):
            raise ValueError(f"{value!r} is a GPU without memory; write fake:8GiB")
        return value


class SchedulingConfig(_Section):
    """Order of the queue."""

    ageing_s_per_point: Seconds = d.AGEING_S_PER_POINT
    """A waiter gains one point of priority per so many seconds, so that none starves."""
    thrash_window_s: Seconds = d.THRASH_WINDOW_S
    """Two consumers that made each other leave within so many seconds are thrashing."""
    thrash_hold_max_s: Annotated[float, Field(ge=0, le=86_400)] = d.THRASH_HOLD_MAX_S
    """Of two consumers that thrash, the resident one stays for the cost of a switch, at most this
    long. 0: never."""


class RevokeConfig(_Section):
    """The ladder towards a holder that is asked to leave."""

    resend_s: Annotated[float, Field(ge=0.01, le=60)] = d.REVOKE_RESEND_S
    """`revoke` is sent again at this interval until the holder acknowledges it."""
    remind_s: Seconds = d.REVOKE_REMIND_S
    """After this long without a safe point the history says so."""
    deadline_s: Seconds = d.REVOKE_DEADLINE_S
    """After this long the history says that the holder is late, and its bytes are not counted
    on: other holders and other GPUs are tried. The holder is never touched."""


class VerifyConfig(_Section):
    """Was the memory really given back?"""

    timeout_s: Seconds = d.VERIFY_TIMEOUT_S
    """A verification ends with a verdict after this long."""
    confirm_s: Annotated[float, Field(ge=0.001, le=1)] = d.VERIFY_CONFIRM_S
    """After a sample that is on target: when the second one is taken, which has to agree."""
    slow_poll_s: Seconds = d.VERIFY_SLOW_POLL_S
    """Pause between samples after a verdict that does not allow a grant."""
    tolerance_bytes: ByteSize = d.VERIFY_TOLERANCE_BYTES
    """Difference between expected and measured bytes that is no difference."""


class ProbeConfig(_Section):
    """Readings of the GPUs."""

    deadline_s: Seconds = d.PROBE_DEADLINE_S
    """A reading that takes longer has failed: the GPU is unknown, which blocks grants."""
    period_s: Seconds = d.PROBE_PERIOD_S
    """Period of background readings while there are leases or waiters."""
    load_s: Annotated[float, Field(ge=0.005, le=60)] = d.LOAD_PROBE_S
    """Period of readings while a lease loads: its load peak is learned from them, and a peak
    between two is not seen."""
    sample_max_age_s: Seconds = d.SAMPLE_MAX_AGE_S
    """An older reading does not gate a grant; a fresh one is taken first."""


class LeaseConfig(_Section):
    """Life of a lease on the daemon's side."""

    fence_grace_s: Annotated[float, Field(ge=0, le=3600)] = d.FENCE_GRACE_S
    """After a lease's ttl and this grace without the arbiter a client unloads by itself."""


class HostConfig(_Section):
    """Memory of the machine itself."""

    park_budget_bytes: ByteSize | None = None
    """Host RAM that parked models may keep together; 0: no parking. Null: half of what is available
    when the daemon starts."""


class LimitsConfig(_Section):
    """Every queue and message has a limit; its breach is a typed error."""

    message_max_bytes: Annotated[ByteSize, Field(ge=4096, le=64 * d.MIB)] = d.MESSAGE_MAX_BYTES
    """Largest request."""
    connections_max: Annotated[int, Field(ge=4, le=65_536)] = d.CONNECTIONS_MAX
    """Connections at a time, with those that have not said hello. Less where the daemon may open
    fewer files (three per connection)."""
    sessions_max: Annotated[int, Field(ge=1, le=65_536)] = d.SESSIONS_MAX
    """Clients at a time: connections that have said hello. An eighth of these, and of a user's
    share, is for processes that have none yet."""
    operator_reserve: Annotated[int, Field(ge=0, le=1024)] = d.OPERATOR_RESERVE
    """Of these, how many only operators get."""
    waiters_max: Annotated[int, Field(ge=1, le=1_000_000)] = d.WAITERS_MAX
    """Queued leases at a time."""
    process_share: Share = d.PROCESS_SHARE
    """Part of the connections, clients, subscribers and places of `waiters_max`, and of the uses of
    another process's lease, that one process may take."""
    user_share: Share = d.USER_SHARE
    """The same for all processes of one user together, but that operators always find room as
    clients."""
    priority_reserve: Annotated[float, Field(ge=0, le=0.5)] = d.PRIORITY_RESERVE
    """Part of the places of `waiters_max` that is kept for requests above the default priority."""
    leases_per_client_max: Annotated[int, Field(ge=1, le=4096)] = d.LEASES_PER_CLIENT_MAX
    """Live leases of one client."""
    uses_per_lease_max: Annotated[int, Field(ge=1, le=65_536)] = d.USES_PER_LEASE_MAX
    """Uses of one lease at a time: its holder's own, and as many of others."""
    rate_per_client_per_s: Annotated[int, Field(ge=10, le=1_000_000)] = d.RATE_PER_CLIENT_PER_S
    """Requests a second of one connection; a burst of one second's worth is allowed. Each KiB of a
    request counts as one more. Beyond it the connection is read more slowly, and nothing is
    lost."""
    rate_per_process_per_s: Annotated[int, Field(ge=10, le=1_000_000)] = d.RATE_PER_PROCESS_PER_S
    """The same for all connections of one process together."""
    subscribers_max: Annotated[int, Field(ge=0, le=65_536)] = d.SUBSCRIBERS_MAX
    """Connections that receive every event."""


class HistoryConfig(_Section):
    """What happened, kept on disk."""

    max_events: Annotated[int, Field(ge=100, le=10_000_000)] = d.HISTORY_MAX_EVENTS
    """Older events are dropped beyond this number."""
    days: Annotated[float, Field(gt=0, le=3650)] = d.HISTORY_DAYS
    """Older events are dropped after this many days."""


class RecordConfig(_Section):
    """The event log: what `vramctl replay` reads."""

    enabled: bool = True
    """Write what the engine was told, and a digest of what it decided, to the state folder."""
    max_bytes: Annotated[ByteSize, Field(ge=128 * d.KIB)] = d.RECORD_MAX_BYTES
    """All files together; the oldest go."""
    file_bytes: Annotated[ByteSize, Field(ge=64 * d.KIB)] = d.RECORD_FILE_BYTES
    """One file; the next one begins with the engine's whole state."""


class WireConfig(_Section):
    """The socket."""

    endpoint: str | None = None
    """`ipc:///run/vram-arbiter/arbiter.sock`. Null: `VRAM_ARBITER_ENDPOINT`, else `arbiter.sock` in
    the runtime folder."""
    heartbeat_s: Annotated[float, Field(ge=0.1, le=60)] = d.HEARTBEAT_S
    """How often clients are asked to say that they are there."""
    group: Annotated[str, Field(min_length=1, max_length=64)] | None = None
    """Unix group that may connect and hold leases, beside the daemon's own user and root. Null:
    that of `operators_group`."""
    operators_group: Annotated[str, Field(min_length=1, max_length=64)] | None = None
    """Unix group that may act by hand (evict, pin, drain), beside the daemon's own user and root.
    Where `group` is set, operators are members of both. Null: no group may."""
    guests_group: Annotated[str, Field(min_length=1, max_length=64)] | None = None
    """Unix group whose members are guests, as robots behind ssh: they mark uses and hold no lease.
    They are members of `group` too, which lets them connect. Null: there are no guests."""

    @field_validator("endpoint")
    @classmethod
    def _ipc_only(cls, value: str | None) -> str | None:
        return None if value is None else check_endpoint(value)


class StateConfig(_Section):
    """Files that outlive the daemon."""

    dir: Annotated[str, Field(min_length=1)] | None = None
    """Folder of journal and history. Null: `$STATE_DIRECTORY` under systemd, else
    `~/.local/state/vram-arbiter`; with a simulated GPU `state` in the runtime folder."""


class LogConfig(_Section):
    """The daemon's log on stderr."""

    format: Literal["human", "json"] = "human"
    """`human`: one readable line each. `json`: one object a line."""
    level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level that is written."""


class ArbiterConfig(_Section):
    """Everything that an operator can set. Sizes may be written `8GiB`, `450MiB`, `5.3GB` or in
    bytes."""

    gpu: GpuConfig = GpuConfig()
    scheduling: SchedulingConfig = SchedulingConfig()
    revoke: RevokeConfig = RevokeConfig()
    verify: VerifyConfig = VerifyConfig()
    probe: ProbeConfig = ProbeConfig()
    lease: LeaseConfig = LeaseConfig()
    host: HostConfig = HostConfig()
    limits: LimitsConfig = LimitsConfig()
    history: HistoryConfig = HistoryConfig()
    record: RecordConfig = RecordConfig()
    wire: WireConfig = WireConfig()
    state: StateConfig = StateConfig()
    log: LogConfig = LogConfig()


LIVE_KEYS: Mapping[str, tuple[str, ...]] = {
    "scheduling": ("thrash_hold_max_s",),
    "revoke": ("resend_s", "remind_s", "deadline_s"),
    "verify": ("timeout_s", "confirm_s", "slow_poll_s"),
    "probe": ("period_s", "load_s", "sample_max_age_s"),
    "limits": ("waiters_max", "priority_reserve", "leases_per_client_max", "uses_per_lease_max"),
    "history": ("max_events", "days"),
    "log": ("level",),
}
"""Keys that a reload applies, by section; the others need a restart. Clients were told the grace
and the heartbeat when they connected, so those two stay as they are."""


def load_config(text: str, name: str) -> ArbiterConfig:
    """Read the text of a configuration file; `name` is how errors call the file.

    Raises ConfigError with every mistake, each with its line: `arbiter.yaml:12: verify.tiemout_s:
    unknown key; did you mean timeout_s?`
    """
    # late: without a file nothing of YAML is needed
    from vram_arbiter.schemas.yamltext import parse_yaml, validated, without_empty

    return validated(ArbiterConfig, without_empty(ArbiterConfig, parse_yaml(text, name)))
