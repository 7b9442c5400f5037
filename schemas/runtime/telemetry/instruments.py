"""Unit, description and bounds of every metric, as a collector shows them.

Durations are in seconds and sizes in bytes; the Prometheus exporter appends `_seconds`, `_bytes`
and `_total` to the names. Labels are listed in docs/reference/metrics.md. Standard library only.
"""

from collections.abc import Mapping
from typing import NamedTuple

from vram_arbiter.schemas.runtime.telemetry import names

WAITS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
WRITES_S = (0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.05, 0.25, 1.0, 5.0)
TICKS_S = (
    0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.033, 0.04, 0.05,
    0.1, 0.25, 0.5, 1.0, 5.0,
)  # fmt: skip
CHATS_S = tuple(0.01 * 2**n for n in range(14))
"""Bounds that OpenTelemetry's conventions give for requests to language models, as these tokens."""
TOKENS = tuple(4.0**n for n in range(14))


class Instrument(NamedTuple):
    """`bounds`: upper bounds of a histogram's buckets; empty for other kinds."""

    unit: str
    description: str
    bounds: tuple[float, ...] = ()


INSTRUMENTS: Mapping[str, Instrument] = {
    # arbiter
    names.METRIC_GRANTS: Instrument("{lease}", "Leases granted"),
    names.METRIC_DENIALS: Instrument("{request}", "Requests for a lease that ended without one"),
    names.METRIC_REFUSALS: Instrument("{request}", "Requests of any kind that were refused"),
    names.METRIC_WAIT: Instrument("s", "From the request to the grant", WAITS_S),
    names.METRIC_WAITERS: Instrument("{request}", "Requests that wait"),
    names.METRIC_OLDEST_WAIT: Instrument("s", "How long the oldest request has waited; 0: none"),
    names.METRIC_EVICTIONS: Instrument("{lease}", "Evictions with a verdict"),
    names.METRIC_VERDICTS: Instrument(
        "{verdict}", "Verdicts on released memory; an unresolved one is followed by another"
    ),
    names.METRIC_LOSSES: Instrument("{lease}", "Leases that ended without a release"),
    names.METRIC_OOMS: Instrument("{report}", "Failed allocations that holders reported"),
    names.METRIC_HANDOVER: Instrument(
        "s", "From the first revoke to the grant that needed the room", WAITS_S
    ),
    names.METRIC_CHARGED: Instrument("By", "Bytes on the ledger"),
    names.METRIC_MEASURED: Instrument("By", "Bytes held by a consumer's processes"),
    names.METRIC_USED: Instrument("By", "Bytes held on the GPU"),
    names.METRIC_CAPACITY: Instrument("By", "Bytes of the GPU"),
    names.METRIC_PRESSURE: Instrument("By", "Bytes held beyond the budget"),
    names.METRIC_READABLE: Instrument("", "1 while the GPU's readings succeed, else 0"),
    names.METRIC_READING_AGE: Instrument("s", "Since the newest successful reading"),
    names.METRIC_DRAINED: Instrument("", "1 while an operator's drain stops grants, else 0"),
    names.METRIC_JOURNAL_HEALTHY: Instrument("", "1 while the journal can be written, else 0"),
    names.METRIC_JOURNAL_DOUBTED: Instrument(
        "", "1 while the journal may not name every lease, which stops grants; else 0"
    ),
    names.METRIC_JOURNAL_WRITE: Instrument("s", "One transaction of the journal", WRITES_S),
    names.METRIC_JOURNAL_FAILURES: Instrument("{failure}", "Transactions that failed"),
    names.METRIC_CONFIG_REFUSED: Instrument(
        "", "1 while a changed configuration is refused and the former one is in force, else 0"
    ),
    names.METRIC_BUILD: Instrument("", "Always 1; the version of the daemon"),
    # runner
    names.METRIC_TICK: Instrument("s", "One tick of the control loop", TICKS_S),
    names.METRIC_INFERENCE: Instrument("s", "One question to the active skill", TICKS_S),
    names.METRIC_CHUNK: Instrument(
        "s", "From the request of a policy's chunk to its answer", WAITS_S
    ),
    names.METRIC_PREFETCH: Instrument("{chunk}", "Chunks that were, or were not, there in time"),
    names.METRIC_STANDING: Instrument("{step}", "Steps of a motion without an action to play"),
    names.METRIC_START_LATE: Instrument(
        "s", "How far behind its slot a goal's tick began", TICKS_S
    ),
    names.METRIC_DEADLINE_MISSES: Instrument("{tick}", "Ticks longer than their time budget"),
    names.METRIC_HAL_READ: Instrument("s", "One reading of the robot's joint state", TICKS_S),
    names.METRIC_HAL_SEND: Instrument("s", "One action sent to the motors", TICKS_S),
    names.METRIC_SENSOR_AGE: Instrument(
        "s", "Age of the newest value when a tick reads it", TICKS_S
    ),
    names.METRIC_STALE_READS: Instrument("{read}", "Reads that gave no fresh value"),
    names.METRIC_WORLD_STALE: Instrument("{state}", "World states with a stale component"),
    names.METRIC_ESTOPS: Instrument("{stop}", "Emergency stops"),
    names.METRIC_SAFETY_VIOLATIONS: Instrument("{violation}", "Reports of the safety gate"),
    names.METRIC_WITHHELD: Instrument("{action}", "Actions that were not sent to the motors"),
    names.METRIC_LOOKS: Instrument("{look}", "Looks of continuous detectors"),
    names.METRIC_STALE_DETECTIONS: Instrument("{answer}", "Detections that became too old"),
    names.METRIC_GOALS: Instrument("{goal}", "Goals that ended"),
    names.METRIC_GPU_MEMORY: Instrument("By", "GPU memory of this process"),
    # sidecars and reasoner
    names.METRIC_SIDECAR_LOAD: Instrument("s", "One load of a model onto the GPU", WAITS_S),
    names.METRIC_SIDECAR_REQUEST: Instrument("s", "One request to a sidecar", TICKS_S),
    names.METRIC_TOOL_CALLS: Instrument("{call}", "Tool calls of the reasoner"),
    names.GEN_AI_TOKENS: Instrument("{token}", "Tokens of a request to a language model", TOKENS),
    names.GEN_AI_DURATION: Instrument("s", "One request to a language model, all tries", CHATS_S),
    # every program
    names.METRIC_CPU_TIME: Instrument("s", "CPU time of this process"),
    names.METRIC_MEMORY: Instrument("By", "RAM of this process"),
}
