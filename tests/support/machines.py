"""How properties are tried: a little in every test run, always the same way and on however slow a
machine; far and at random in the night.

`steady`, the profile of a usual run, gives no example a time limit: a machine that stands still for
a moment is no failure, and what fails once fails again. HYPOTHESIS_PROFILE or pytest's
`--hypothesis-profile` chooses `nightly`; `make nightly` splits its histories over the cores
(`tests/nightly`). A rule machine takes part with `TestThis.settings = walk(60)`, and in the night
with a line in `tests/nightly/nightly_run.py`.
"""

import os

from hypothesis import HealthCheck, Phase, settings

STEADY, NIGHTLY = "steady", "nightly"
NIGHTLY_EXAMPLES = 100_000


def register(nightly_examples: int = NIGHTLY_EXAMPLES) -> None:
    """Make both profiles known, and load the one that HYPOTHESIS_PROFILE names; `steady` if it
    names none."""
    settings.register_profile(
        STEADY,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow],
        print_blob=True,
    )
    settings.register_profile(
        NIGHTLY,
        max_examples=nightly_examples,
        derandomize=False,
        database=None,  # a night is told again by its seeds
        deadline=None,
        print_blob=True,
    )
    settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE") or STEADY)


def walk(examples: int, *, nightly_share: float = 1.0) -> settings:
    """Settings of one machine. `examples`: in a usual test run, so that it takes less than 15 s
    there. `nightly_share`: of the histories that the nightly profile says."""
    nightly = settings.get_current_profile_name() == NIGHTLY
    return settings(
        max_examples=max(1, round(nightly_share * settings().max_examples))
        if nightly
        else examples,
        stateful_step_count=40,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        derandomize=not nightly,
        print_blob=True,
        # shrinking takes minutes: a usual run tells what it found as it found it
        phases=[Phase.generate, Phase.shrink] if nightly else [Phase.generate],
    )
