"""Counts and measurements by the names of `schemas.runtime.telemetry.names`. On the API alone:
costs next to nothing until `schemas.runtime.telemetry.setup` has installed an SDK.

Labels are ATTR_ names with values from small sets (a skill, a tool, an operation, a code of an
error), never ids: each combination is a series that is kept as long as the process lives.
"""

import math
from collections.abc import Mapping
from functools import cache

from opentelemetry import metrics

from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS

Labels = Mapping[str, str]

_METER = metrics.get_meter(telemetry.TRACER)  # a proxy: it finds the SDK whenever that comes


def count(name: str, labels: Labels | None = None, times: int = 1) -> None:
    """Something happened `times` times."""
    _counter(name).add(times, exported.labels(labels))


def shift(name: str, by: int, labels: Labels | None = None) -> None:
    """A level changed by so much; 0 makes its series known."""
    _level(name).add(by, exported.labels(labels))


def measure(name: str, value: float, labels: Labels | None = None) -> None:
    """One value of a distribution, in the unit of its name. What is no number, or negative, is no
    measurement and left out."""
    if math.isfinite(value) and value >= 0:
        _histogram(name).record(value, exported.labels(labels))


@cache
def _counter(name: str) -> metrics.Counter:
    return new_counter(_METER, name)


@cache
def _level(name: str) -> metrics.UpDownCounter:
    return _METER.create_up_down_counter(name, *INSTRUMENTS[name][:2])


@cache
def _histogram(name: str) -> metrics.Histogram:
    return new_histogram(_METER, name)


def new_counter(meter: metrics.Meter, name: str) -> metrics.Counter:
    """Create a counter as the catalogue describes it."""
    return meter.create_counter(name, *INSTRUMENTS[name][:2])


def new_histogram(meter: metrics.Meter, name: str) -> metrics.Histogram:
    """Create a histogram as the catalogue describes it."""
    unit, description, bounds = INSTRUMENTS[name]
    return meter.create_histogram(
        name, unit, description, explicit_bucket_boundaries_advisory=bounds
    )
