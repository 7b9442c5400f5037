"""The training loop: its limits, and what the seed decides."""

import itertools
import math

import pytest

from training import common


@pytest.mark.parametrize(
    "wrong", [{"time_limit_s": 0.0}, {"time_limit_s": math.nan}, {"steps": 0}, {"batch": -1}]
)
def test_a_run_without_a_step_is_refused(wrong: dict[str, float]) -> None:
    """Regression: figures of a run without a step divided by zero after the data were read."""
    (name, value) = next(iter(wrong.items()))
    with pytest.raises(common.BadInput, match=f"--{name.replace('_', '-')} .* got {value}"):
        common.Recipe(**{"steps": 1, "batch": 1, "time_limit_s": 1.0} | wrong)


@pytest.mark.heavy
def test_a_time_limit_that_no_step_fits_still_makes_one() -> None:
    """Regression: on a busy machine the limit was over before the first step, and the figures of
    no step divided by zero."""
    import torch

    weight = torch.nn.Parameter(torch.tensor(4.0))
    optimizer = torch.optim.SGD([weight])
    rates = []

    def rate(step: int, share: float) -> float:
        rates.append((step, share))
        return 0.5 * common.cosine(share)

    run = common.fit(
        "x", [weight], optimizer, rate, lambda: (weight**2 / 2, {"loss": weight.item()}),
        steps=100, time_limit_s=1e-9,
    )  # fmt: skip
    assert rates == [(0, 0.0)]
    assert run.figures()["steps"] == 1
    assert run.figures()["loss"] == 4.0
    assert weight.item() == pytest.approx(3.5), "the gradient is cut to 1"


def test_the_rate_rises_and_falls() -> None:
    rates = [common.cosine_after_warmup(step, 1000, 30) for step in range(1000)]
    assert rates[0] == 1 / 30
    assert max(rates) == rates[29] == 1.0
    assert rates[29:] == sorted(rates[29:], reverse=True)
    assert common.cosine(1.0) == pytest.approx(0.02)


def test_batches_show_everything_once_a_pass_and_follow_the_seed() -> None:
    def drawn(seed: int) -> list[list[int]]:
        return list(itertools.islice(common.batches(10, 4, seed), 5))

    assert sorted(itertools.chain(*drawn(3))) == sorted([*range(10)] * 2)
    assert drawn(3) == drawn(3) != drawn(4)


def test_shares_and_tables() -> None:
    assert common.share([True, None, 1, 0]) == 0.5
    assert common.share([]) == 0.0
    assert common.table([{"a": 1, "b": "x"}]) == "| a | b |\n| --- | --- |\n| 1 | x |"
