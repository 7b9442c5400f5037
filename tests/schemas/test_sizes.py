"""Byte sizes as people write them."""

import pytest

from vram_arbiter.clients._spec import lease_spec
from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.sizes import parse_bytes, parse_need


@pytest.mark.parametrize(
    ("written", "size"), [("5GiB", 5 << 30), (" 5.3 GB ", 5_300_000_000), ("450MiB", 450 << 20)]
)
def test_what_a_person_needs(written: str, size: int) -> None:
    assert parse_need(written) == parse_bytes(written) == size


@pytest.mark.parametrize("written", ["5", "5.3", "0", "0GiB", "", "GiB", "9" * 400 + "GiB"])
def test_a_need_has_a_unit_and_is_not_nothing(written: str) -> None:
    """`--vram 5` was five bytes, `--vram 0` none, and 400 digits ended in an OverflowError."""
    with pytest.raises(
        ValueError, match=r"such as 5GiB|not a size|expected a size of 0 to 8 EiB"
    ) as told:
        parse_need(written)
    assert len(str(told.value)) < 120
    with pytest.raises(BadRequest):
        lease_spec(None, "x", written, None, {})


@pytest.mark.parametrize("written", [-1, 1 << 63, 10**4000, str(1 << 63)])
def test_a_number_of_bytes_is_bounded_as_a_text_is(written: int | str) -> None:
    """Regression: only texts were bounded."""
    with pytest.raises(ValueError, match=r"expected a size of 0 to 8 EiB, got -?\d{1,40}$"):
        parse_bytes(written)
    assert parse_bytes((1 << 63) - 1) == (1 << 63) - 1


def test_a_size_is_a_number_of_bytes_or_a_text() -> None:
    with pytest.raises(BadRequest, match="not 5000000000"):
        lease_spec(None, "x", 5e9, None, {})  # type: ignore[arg-type]
