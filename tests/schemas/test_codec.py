"""The codec of wire, journal and log: what is written, what is read back, and what is refused."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar, get_type_hints

import pytest

from vram_arbiter.schemas import codec
from vram_arbiter.schemas.codec import CodecError, from_map, to_map
from vram_arbiter.schemas.ids import LeaseId, Token
from vram_arbiter.schemas.wire.errors import ErrorView


class Color(StrEnum):
    RED = "red"


@dataclass(frozen=True, slots=True)
class Cat:
    TAG: ClassVar = ("animal", "cat")

    name: str
    lives: int = 9


@dataclass(frozen=True, slots=True)
class Dog:
    TAG: ClassVar = ("animal", "dog")

    name: str


@dataclass(frozen=True, slots=True)
class Everything:
    lease: LeaseId
    token: Token | None
    tokens: tuple[Token, ...]
    pair: tuple[int, str]
    pet: Cat | Dog
    by_name: Mapping[str, Token]
    color: Color = Color.RED
    pets: tuple[Cat | Dog, ...] = ()
    own: "Everything | None" = None
    free: Mapping[str, Any] = field(default_factory=dict)


FULL = Everything(
    LeaseId("L1-1"),
    Token(1, 2),
    (Token(1, 3), Token(1, 4)),
    (5, "five"),
    Cat("tom", 8),
    {"a": Token(2, 1)},
    pets=(Dog("rex"), Cat("kit")),
    own=Everything(LeaseId("L1-2"), None, (), (1, "1"), Dog("ace"), {}),
    free={"x": [1, 2]},
)


def test_values_come_back_as_they_were_and_defaults_are_not_written() -> None:
    plain = to_map(FULL)
    assert plain["token"] == [1, 2]
    assert plain["pet"] == {"animal": "cat", "name": "tom", "lives": 8}
    assert plain["pets"][1] == {"animal": "cat", "name": "kit"}
    assert "color" not in plain
    assert (plain["own"]["token"], plain["own"]["tokens"]) == (None, []), (
        "what has no default stays"
    )
    assert from_map(Everything, plain, strict=True) == FULL


def test_a_client_ignores_what_only_a_newer_arbiter_knows() -> None:
    newer = {**to_map(FULL), "weather": "fine", "color": "green"}
    assert from_map(Everything, newer).color == "green"
    with pytest.raises(CodecError, match="Everything has no field weather"):
        from_map(Everything, newer, strict=True)


@pytest.mark.parametrize(
    ("damaged", "problem"),
    [
        ({}, "Everything lacks by_name, lease, pair, pet, token, tokens"),
        ({**to_map(FULL), "token": 7}, "expected a list of 2, got 7"),
        ({**to_map(FULL), "tokens": {}}, "expected a list, got {}"),
        ({**to_map(FULL), "pair": [1]}, r"expected a list of 2, got \[1\]"),
        ([], r"Everything: expected a map, got \[\]"),
    ],
)
def test_what_does_not_fit_is_named(damaged: Any, problem: str) -> None:
    with pytest.raises(CodecError, match=problem):
        from_map(Everything, damaged)


def test_a_class_that_is_written_whole_says_its_empty_map_too() -> None:
    """Regression: `details` of an error was left out where it was empty, so that a program of
    another language found no such key."""
    assert to_map(ErrorView("x")) == {"code": "x", "message": "", "hint": "", "details": {}}


@pytest.mark.parametrize("converted", [to_map, lambda plain: from_map(Everything, plain)])
def test_a_thread_never_meets_half_a_table(
    monkeypatch: pytest.MonkeyPatch, converted: Callable[[Any], Any]
) -> None:
    """Regression: a second thread used the table of a class while the first one filled it, and
    left out the fields that were not there yet. Here the second comes in the middle."""
    value: Any = FULL if converted is to_map else to_map(FULL)
    codec._encoder.cache_clear()
    codec._decoder.cache_clear()
    inner: list[Any] = []

    def hints(cls: type) -> dict[str, Any]:
        found = get_type_hints(cls)
        return Nosy(found) if cls is Everything and not inner else found

    class Nosy(dict[str, Any]):
        def __getitem__(self, key: str) -> Any:
            if key == "color" and not inner:
                inner.append(None)
                inner[:] = [converted(value)]
            return super().__getitem__(key)

    monkeypatch.setattr(codec, "get_type_hints", hints)
    assert converted(value) == inner[0] == converted(value)


def test_only_dataclasses_have_a_plain_form() -> None:
    with pytest.raises(TypeError, match="int is not a dataclass"):
        to_map(7)


@dataclass(frozen=True, slots=True)
class Nothing:
    TAG: ClassVar = ("animal", "none")


@dataclass(frozen=True, slots=True)
class One:
    name: str


@pytest.mark.parametrize("value", [Nothing(), One("a")])
def test_classes_of_no_field_and_of_one_have_a_map(value: Any) -> None:
    assert from_map(type(value), to_map(value)) == value


@pytest.mark.parametrize("value", [Nothing(), One("a")])
def test_the_hints_of_a_class_are_read_once(monkeypatch: pytest.MonkeyPatch, value: Any) -> None:
    """Regression: those of a class without fields, such as `Ping`, were read with each value."""
    assert from_map(type(value), to_map(value)) == value
    monkeypatch.setattr(codec, "get_type_hints", None)
    assert from_map(type(value), to_map(value)) == value
