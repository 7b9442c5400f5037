"""Scenarios: the shipped ones are valid, and every mistake is named with its line."""

from pathlib import Path

import pytest

from tests.support.paths import ROOT
from vram_arbiter.schemas.config.scenario import (
    Arrivals,
    Scenario,
    ScenarioConsumer,
    ScenarioGpu,
    Stowaway,
    load_scenario,
)
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.sizes import parse_bytes

SHIPPED = sorted((ROOT / "configs" / "scenarios").glob("*.yaml"))
SMALL = """\
about: one
seconds: 10
gpus:
  - capacity: 8GiB
consumers:
  a:
    load_peak: 2GiB
    use_s: 1
    arrivals: {every_s: 5}
"""


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_scenario_is_valid_and_says_what_it_is(path: Path) -> None:
    scenario = load_scenario(path.read_text(), path.name)
    assert scenario.about
    assert path.read_text().startswith("# ")


def test_the_defaults_of_a_small_one() -> None:
    scenario = load_scenario(SMALL, "s.yaml")
    consumer = scenario.consumers["a"]
    assert (consumer.load_peak, consumer.use_s, consumer.evictable) == (
        parse_bytes("2GiB"),
        (1.0, 1.0),
        True,
    )
    assert scenario.gpus[0].release_lag_s == 0.5


@pytest.mark.parametrize("model", [Scenario, ScenarioGpu, ScenarioConsumer, Arrivals, Stowaway])
def test_every_key_that_is_not_plain_says_what_it_is(model: type[Scenario]) -> None:
    silent = {name for name, field in model.model_fields.items() if not field.description}
    assert silent <= {"gpus", "consumers", "stowaways", "name"}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "use_s: 1",
            "use_s: 1\n    lod_s: 3",
            "s.yaml:9: consumers.a.lod_s: unknown key; did you mean load_s?",
        ),
        (
            "every_s: 5",
            "every: 5",
            "s.yaml:9: consumers.a.arrivals.every: unknown key; did you mean every_s?",
        ),
        ("capacity: 8GiB", "capacity: lots", "s.yaml:4: gpus[0].capacity: "),
        ("capacity: 8GiB", "capacity: 8GiB\n    lag: 1", "s.yaml:5: gpus[0].lag: unknown key"),
        (
            "every_s: 5",
            "every_s: 5, per_minute: 3",
            "give exactly one of at_s, every_s, per_minute and after",
        ),
        ("every_s: 5", "after: b", "consumers.a.arrivals.after: there is no consumer 'b'"),
        ("use_s: 1", "use_s: 1\n    gpu: '3'", "consumers.a.gpu: '3' is not a GPU"),
        (
            "use_s: 1",
            "use_s: 1\n    steady: 3GiB",
            "consumers.a.steady is larger than its load_peak",
        ),
        ("seconds: 10", "seconds: -1", "s.yaml:2: seconds: "),
        ("about: one", "about: one\nstowaways: [{name: x, bytes: 1, gpu: 1}]", "x is on GPU 1"),
        ("about: one\n", "", "about: is missing"),
        ("about: one", "about: [", "not valid YAML"),
    ],
)
def test_a_mistake_is_named_with_its_line(old: str, new: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario(SMALL.replace(old, new), "s.yaml")
    assert says in str(caught.value)
