"""Nothing that another program said reaches a terminal as a control: escapes would forge what an
operator reads."""

import unicodedata

from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.schemas.runtime.printable import printable, printable_lines


def test_plain_words_stay_as_they_are() -> None:
    assert printable("détecteur 腕 #3 [red] \\ 5 µs") == "détecteur 腕 #3 [red] \\ 5 µs"


def test_controls_are_shown_instead_of_obeyed() -> None:
    hostile = "a\x1b[2Jb\x9b31mc\u202ed\u2066e\nf\u200bg\x00h\udcffi\u2028j"
    shown = "a\\x1b[2Jb\\x9b31mc\\u202ed\\u2066e\\nf\\u200bg\\x00h\\udcffi\\u2028j"
    assert printable(hostile) == shown


@given(st.text(st.characters(codec=None)))
def test_no_control_is_left_and_nothing_is_lost(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert not any(
        unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp") for letter in shown
    )
    assert printable(shown) == shown
    shown.encode()  # a lone surrogate would end a print with a traceback


@given(st.text())
def test_lines_stay_lines(text: str) -> None:
    shown = printable_lines(text)
    assert shown.count("\n") == text.count("\n")
    assert all(line.isprintable() for line in shown.split("\n"))
