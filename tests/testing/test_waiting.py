"""A wait ends with a true value, or says what was seen last."""

import pytest

from vram_arbiter.testing.waiting import eventually


def test_the_true_value_is_returned() -> None:
    seen = iter([0, "", None, "there"])
    assert eventually(lambda: next(seen)) == "there"


def test_a_failing_assertion_counts_as_not_yet() -> None:
    seen = iter(["loading", "held"])

    def held() -> bool:
        state = next(seen)
        assert state == "held", f"it is {state}"
        return True

    assert eventually(held)


@pytest.mark.parametrize(("found", "said"), [(0, "0"), ("", "''"), (AssertionError("odd"), "odd")])
def test_the_limit_says_what_was_seen_last(found: object, said: str) -> None:
    def look() -> object:
        if isinstance(found, AssertionError):
            raise found
        return found

    with pytest.raises(AssertionError, match=f"^not true within 0 s, last seen: {said}$"):
        eventually(look, within_s=0.0)


def test_other_errors_end_the_wait() -> None:
    with pytest.raises(ZeroDivisionError):
        eventually(lambda: 1 / 0)
