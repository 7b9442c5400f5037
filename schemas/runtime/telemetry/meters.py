"""Counts and measurements by the names of `schemas.runtime.telemetry.names`. On the API alone:
costs next to nothing until `schemas.runtime.telemetry.setup` has installed an SDK.

Labels are ATTR_ names with values from small sets (a skill, a tool, an operation, a code of an
error), never ids: each combination is a series that is kept as long as the process lives.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from opentelemetry import metrics

from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

Labels = Mapping[str, str]

_METER = metrics.get_meter(telemetry.TRACER)  # a proxy: it finds the SDK whenever that comes


class Instrument(NamedTuple):
    """Unit and description of a metric, as a collector shows them."""

    unit: str
    description: str


INSTRUMENTS: Mapping[str, Instrument] = {
    telemetry.METRIC_TICK: Instrument("s", "One tick of the control loop"),
    telemetry.METRIC_INFERENCE: Instrument("s", "One question to the active skill"),
    telemetry.METRIC_CHUNK: Instrument("s", "From the request of a policy's chunk to its answer"),
    telemetry.METRIC_PREFETCH: Instrument(
        "{chunk}", "Chunks that were, or were not, there in time"
    ),
    telemetry.METRIC_STANDING: Instrument("{step}", "Steps of a motion without an action to play"),
    telemetry.METRIC_START_LATE: Instrument("s", "How far behind its slot a goal's tick began"),
    telemetry.METRIC_DEADLINE_MISSES: Instrument("{tick}", "Ticks longer than their time budget"),
    telemetry.METRIC_HAL_READ: Instrument("s", "One reading of the robot's joint state"),
    telemetry.METRIC_HAL_SEND: Instrument("s", "One action sent to the motors"),
    telemetry.METRIC_SENSOR_AGE: Instrument("s", "Age of the newest value when a tick reads it"),
    telemetry.METRIC_STALE_READS: Instrument("{read}", "Reads that gave no fresh value"),
    telemetry.METRIC_WORLD_STALE: Instrument("{state}", "World states with a stale component"),
    telemetry.METRIC_ESTOPS: Instrument("{stop}", "Emergency stops"),
    telemetry.METRIC_SAFETY_VIOLATIONS: Instrument("{violation}", "What the safety gate reported"),
    telemetry.METRIC_WITHHELD: Instrument("{action}", "Actions that were not sent to the motors"),
    telemetry.METRIC_LOOKS: Instrument("{look}", "Looks of continuous detectors"),
    telemetry.METRIC_STALE_DETECTIONS: Instrument("{look}", "Detections that became too old"),
    telemetry.METRIC_GOALS: Instrument("{goal}", "Goals that ended"),
    telemetry.METRIC_TOOL_CALLS: Instrument("{call}", "Tool calls of the reasoner"),
    telemetry.METRIC_SIDECAR_LOAD: Instrument("s", "One load of a model onto the GPU"),
    telemetry.METRIC_SIDECAR_REQUEST: Instrument("s", "One request to a sidecar"),
    telemetry.GEN_AI_TOKENS: Instrument("{token}", "Tokens of a request to a language model"),
    telemetry.GEN_AI_DURATION: Instrument("s", "One request to a language model, all tries"),
}


def count(name: str, labels: Labels | None = None, times: int = 1) -> None:
    """Something happened `times` times."""
    _counter(name).add(times, exported.labels(labels))


def measure(name: str, value: float, labels: Labels | None = None) -> None:
    """One value of a distribution, in the unit of its name. What is no number, or negative, is no
    measurement and left out."""
    if math.isfinite(value) and value >= 0:
        _histogram(name).record(value, exported.labels(labels))


@cache
def _counter(name: str) -> metrics.Counter:
    unit, description = INSTRUMENTS[name]
    return _METER.create_counter(name, unit, description)


@cache
def _histogram(name: str) -> metrics.Histogram:
    unit, description = INSTRUMENTS[name]
    return _METER.create_histogram(name, unit, description)
