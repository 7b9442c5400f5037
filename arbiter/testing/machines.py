"""How long the rule machines of the core walk: a little in every test run, always the same way; far and at random with
`--hypothesis-profile=nightly` (`make nightly`). The profile is registered in `tests/conftest.py`."""

from hypothesis import HealthCheck, settings

NIGHTLY = "nightly"
NIGHTLY_EXAMPLES = 2000


def walk(examples: int) -> settings:
    """Settings of one machine. `examples`: in a usual test run, so that it takes less than 15 s there."""
    nightly = settings.get_current_profile_name() == NIGHTLY
    return settings(
        max_examples=NIGHTLY_EXAMPLES if nightly else examples,
        stateful_step_count=40,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        derandomize=not nightly,
        print_blob=nightly,
    )
