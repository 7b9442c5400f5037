"""Stories: text files that play the engine and hold everything that it answers.

A story is prose with commands, `>>> vlm.acquire(3 * GIB)`, as in a doctest. `retold` runs them on a
`CoreDriver` and writes below each command what the engine did: for each event its time and its
effects with all their fields, and when the engine wants to be called next. Ticks and readings that
bring nothing are counted in one line. To stay readable, a field that has its default is left out,
and a view or record of a lease or GPU shows what changed since it was last shown.

`make stories` writes the answers anew: their diff shows what the engine does otherwise.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from doctest import DocTestParser, Example
from functools import partial
from pathlib import Path
from textwrap import TextWrapper
from typing import Any

from tests.support import core_driver
from tests.support.core_driver import START_S, Consumer, CoreDriver
from vram_arbiter.arbiter.core import events
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Sample
from vram_arbiter.schemas import defaults, ids
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId

KEYS = ("lease_id", "gpu")
"""Fields that name what a view, a record or an explanation is about."""
QUIET = (events.Tick, events.MemorySampled, events.ProbeFailed)
REPEATED = ("LeaseView", "LeaseRecord", "Explanation", "LeaseDetail", "GpuView", "StatusReply")
"""Dataclasses that are shown by what changed."""
PLAIN = ("client", "body", "refusal", "about", "key", "record", *KEYS)
"""Fields that are shown without their names."""
LEFT_OUT = ("request",)
"""The driver checks the numbers of requests, and one command more would change all that follow."""
LAYOUT = TextWrapper(100, "  ", " " * 6, break_long_words=False, break_on_hyphens=False)
SUFFIXES = ("Note", "Push", "Reply", "View", "Record")


def retold(text: str) -> str:
    """Return a story with the answers that the engine gives now."""
    story = _Story()
    pieces = DocTestParser().parse(text)
    return "".join(piece if isinstance(piece, str) else story.played(piece) for piece in pieces)


class _Story:
    """One run of a story, and what it has shown."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._shown: dict[tuple[str, str], dict[str, Any]] = {}
        self._quiet: Counter[str] = Counter()
        self._quiet_at: list[str] = []
        self._next = ""
        driver = partial(CoreDriver, engine=partial(_ToldArbiter, self))
        tools = {"CoreDriver": driver, "tell": self.tell, "holder": self.holder}
        self._names = {**vars(defaults), **vars(ids), **vars(events), **vars(core_driver), **tools}

    def played(self, command: Example) -> str:
        """Run a command. Return it with the answers."""
        self._lines = []
        exec(command.source, self._names)
        self._tell_quiet()
        source = command.source.rstrip("\n").replace("\n", "\n... ")
        return "\n".join([f">>> {source}", *self._lines, ""])

    def tell(self, value: object) -> None:
        """Write down what a question was answered."""
        self._tell_quiet()
        self._line(self._words(value))

    def forget(self) -> None:
        """Show every field again: another engine begins."""
        self._shown.clear()

    def holder(
        self, driver: CoreDriver, name: str, *sizes: int, **spec: Any
    ) -> tuple[Consumer, LeaseId]:
        """Return a consumer and its lease, which is loaded and was read. How they came there is
        left out."""
        before = list(self._lines)
        consumer = driver.consumer(name)
        lease = consumer.acquire(*sizes, **spec)
        consumer.load(lease)
        driver.advance(0.1)
        self._tell_quiet()
        self._lines = before
        return consumer, lease

    def handled(
        self, event: events.Event, now: float, effects: list[Effect], due: float | None
    ) -> None:
        """Write down an event, and what the engine answered."""
        what = event.request if isinstance(event, events.Asked) else event
        name = type(what).__name__
        if isinstance(event, QUIET) and all(isinstance(effect, Sample) for effect in effects):
            self._quiet[name] += 1
            self._quiet_at.append(_at(now))
            self._next = _at(due)
            return
        self._tell_quiet()
        self._lines.append(f"{_at(now)} {name}, next at {_at(due)}")
        for effect in effects:
            self._line(self._words(effect))

    def _tell_quiet(self) -> None:
        if self._quiet:
            ends = " to ".join(dict.fromkeys([self._quiet_at[0], self._quiet_at[-1]]))
            counts = ", ".join(f"{count} {name}" for name, count in sorted(self._quiet.items()))
            self._lines.append(f"{ends} {counts}, next at {self._next}")
        self._quiet.clear()
        self._quiet_at.clear()

    def _line(self, text: str) -> None:
        self._lines += LAYOUT.wrap(text)

    # -- values
    def _words(self, value: Any, name: str = "") -> str:
        if is_dataclass(value) and not isinstance(value, type):
            return self._fields(value)
        if isinstance(value, Mapping):
            shown = [f"{key}:{self._words(item, name)}" for key, item in value.items()]
            return f"{{{' '.join(shown)}}}"
        if type(value) in (tuple, list):
            return f"[{' '.join([self._words(item) for item in value])}]"
        if isinstance(value, float):
            return f"{value:.4f}".rstrip("0").rstrip(".")
        if isinstance(value, int) and name.endswith("bytes"):
            return _bytes(value)
        text = str(value)
        return f"'{text}'" if " " in text or not text else text

    def _fields(self, value: Any) -> str:
        kind = type(value).__name__
        own = {field.name: getattr(value, field.name) for field in fields(value)}
        key = next((name for name in KEYS if name in own), "")
        about = (kind, str(own.get(key)))
        before = self._shown.get(about, {}) if kind in REPEATED else {}
        self._shown[about] = own
        shown = [
            ("" if name in PLAIN else f"{_short(name)}=") + self._words(own[name], name)
            for name, usual in ((field.name, _usual(field)) for field in fields(value))
            if name not in LEFT_OUT and (name == key or own[name] != before.get(name, usual))
        ]
        short = next((kind.removesuffix(one) for one in SUFFIXES if kind.endswith(one)), "") or kind
        return f"{short}({' '.join(shown)})"


class _ToldArbiter(Arbiter):
    """The engine, heard by a story."""

    def __init__(self, story: _Story, *made: Any) -> None:
        super().__init__(*made)
        self._story = story
        story.forget()

    def handle(self, event: events.Event, now: float) -> list[Effect]:
        effects = super().handle(event, now)
        self._story.handled(event, now, effects, self.next_deadline())
        return effects


def _usual(field: "Field[Any]") -> object:
    """Return what a field that is not shown has."""
    return None if field.default is MISSING else field.default


def _at(now: float | None) -> str:
    return "never" if now is None else f"{now - START_S:.3f}"


def _bytes(count: int) -> str:
    whole = round(count / MIB)
    rest = count - whole * MIB
    size = f"{whole * MIB // GIB}G" if whole * MIB % GIB == 0 else f"{whole}M"
    return size if not rest else f"{rest:+d}" if not whole else f"{size}{rest:+d}"


def _short(name: str) -> str:
    return name.removesuffix("_bytes").removesuffix("_s")


def main() -> None:
    for path in map(Path, sys.argv[1:]):
        path.write_text(retold(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
