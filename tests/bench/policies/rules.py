"""The engine beside ports of other programs' scheduling rules, with the same consumers and GPU:
`python -m tests.bench.policies.rules [SCENARIO …]` prints the figures of
docs/explanation/policies.md.

The ports get the same events and answer with the same effects as the engine, but decide as their
originals do, by these sources:

- `unmanaged`: no decision, every process loads at once, as without any of these programs.
- `ollama_rules` (ollama, server/sched.go): first come first served. A model that fits into free
  memory loads beside the others, else the first idle one (else the first) is unloaded, one at a
  time. Free memory is awaited until 80 % of the estimate are back or 5 s are over, then it goes on
  anyway. During an unload all other requests wait. At most three models.
- `llama_swap_rules` (llama-swap without groups): one model at a time; the running requests of the
  present one end, its process ends, and the next one starts at once, without a look at the GPU.

All of them start and end model processes, so nothing stays on the GPU after an unload. None knows
priorities, pins or load peaks.
"""

import argparse
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[3] / "src"), str(Path(__file__).parents[3])]

from tests.bench.policies.actors import START_S
from tests.bench.policies.outcome import Outcome, table
from tests.bench.policies.scenarios import SCENARIOS, Scenario
from tests.bench.policies.simulator import World
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Note, Push, Refuse, Reply, Sample
from vram_arbiter.arbiter.core.events import Asked, ClientConnected, Event, MemorySampled, Tick
from vram_arbiter.arbiter.core.model.refusals import Revoked, TooLarge
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.schemas.ids import ClientId, LeaseId, Token
from vram_arbiter.schemas.wire.notes import About, AnyNote, GrantedNote, RevokeAskedNote, SwitchNote
from vram_arbiter.schemas.wire.pushes import GrantedPush, RevokePush
from vram_arbiter.schemas.wire.replies import AcquireReply, DoneReply
from vram_arbiter.schemas.wire.requests import Acquire, Ready, Release, Unloading, UseBegin, UseEnd
from vram_arbiter.schemas.wire.spec import LeaseSpec
from vram_arbiter.schemas.wire.views import LeaseView

OLLAMA_MODELS = 3
OLLAMA_POLL_S = 0.25
OLLAMA_RECOVERED = 0.8
OLLAMA_PATIENCE_S = 5.0


@dataclass(slots=True)
class _Model:
    """One lease as these programs would see it: a model that is loaded or waits to load."""

    id: LeaseId
    client: ClientId
    spec: LeaseSpec
    arrived_at: float
    state: str = "queued"  # queued, loading, held, leaving
    uses: set[str] = field(default_factory=set)
    owed: bool = True  # the request that loaded it is not served yet: it is not idle
    evicted: list[str] = field(default_factory=list)  # models that left for it
    wanted_by: "_Model | None" = None  # it has to leave, and is revoked when it owes nothing


class Rules(ABC):
    """Bookkeeping that the ports share; `_serve` decides."""

    def __init__(self, gpu: GpuInfo) -> None:
        self._gpu = gpu
        self._now = 0.0
        self._out: list[Effect] = []
        self._models: dict[LeaseId, _Model] = {}  # in the order of their loading
        self._queue: list[_Model] = []
        self._used_bytes = 0
        self._timer: float | None = None
        self._serial = 0

    def next_deadline(self) -> float | None:
        return self._timer

    def handle(self, event: Event, now: float) -> list[Effect]:
        self._now, self._out = now, []
        match event:
            case ClientConnected():
                pass
            case Asked():
                self._asked(event)
            case MemorySampled():
                self._used_bytes = event.used_bytes
            case Tick() if self._timer is not None and self._timer <= now:
                self._timer = None
            case _:
                pass
        self._serve()
        return self._out

    # -- bookkeeping
    def _asked(self, asked: Asked) -> None:
        match asked.request:
            case Acquire(spec=spec):
                self._acquire(asked, spec)
            case Ready(lease):
                model = self._models[lease]
                model.state = "held"
                self._out.append(Reply(asked.client, asked.id, DoneReply()))
                self._note(self._switch(model), model)
            case UseBegin(lease, _, use):
                if self._models[lease].state == "leaving":
                    refusal = Revoked(self._models[lease].spec.consumer, "leaving")
                    self._out.append(Refuse(asked.client, asked.id, refusal))
                else:
                    self._models[lease].uses.add(use)
            case UseEnd(lease, _, use):
                if (ending := self._models.get(lease)) is not None:
                    ending.uses.discard(use)
                    self._served(ending)
            case Unloading(lease):
                self._models[lease].state = "leaving"
            case Release(lease):
                self._gone(lease)

    def _acquire(self, asked: Asked, spec: LeaseSpec) -> None:
        self._serial += 1
        model = _Model(LeaseId(f"R-{self._serial}"), asked.client, spec, self._now)
        if spec.footprint.steady_bytes > self._gpu.capacity_bytes:
            size, total = spec.footprint.steady_bytes, self._gpu.capacity_bytes
            refusal = TooLarge(spec.consumer, size, size, total, 0)
            self._out.append(Refuse(asked.client, asked.id, refusal))
            return
        self._queue.append(model)
        self._out.append(Reply(asked.client, asked.id, AcquireReply("queued", self._view(model))))

    def _view(self, model: _Model) -> LeaseView:
        spec = model.spec
        return LeaseView(
            lease_id=model.id,
            token=Token(1, self._serial),
            state="queued" if model.state == "queued" else "loading",
            consumer=spec.consumer,
            model=spec.model,
            gpu=self._gpu.id,
            mode="shared",
            priority=spec.priority,
            evictable=spec.evictable,
            charge_bytes=spec.footprint.load_peak_bytes,
            uses=len(model.uses),
            pid=0,
            since_s=0.0,
        )

    def _note(self, body: AnyNote, model: _Model) -> None:
        about = About(LeaseId(model.id), model.spec.consumer, self._gpu.id)
        self._out.append(Note(body, about))

    def _switch(self, model: _Model) -> SwitchNote:
        """Only the total is known: these programs do not tell phases apart."""
        total_ms = (self._now - model.arrived_at) * 1e3
        return SwitchNote(bool(model.evicted), (), False, 0.0, 0.0, 0.0, 0.0, 0.0, total_ms)

    def _load(self, model: _Model) -> None:
        self._queue.remove(model)
        self._models[model.id] = model
        model.state = "loading"
        waited_ms = (self._now - model.arrived_at) * 1e3
        evicted = tuple(model.evicted)
        self._note(GrantedNote(model.spec.footprint.load_peak_bytes, waited_ms, evicted), model)
        self._out.append(Push(model.client, GrantedPush(self._view(model))))

    def _ask(self, model: _Model, wanted_by: _Model) -> None:
        """Unload when its requests are served, including the one that it was loaded for."""
        if model.spec.consumer not in wanted_by.evicted:
            wanted_by.evicted.append(model.spec.consumer)
        asked = RevokeAskedNote(
            wanted_by.spec.consumer, LeaseId(wanted_by.id), len(model.uses), "waiter"
        )
        self._note(asked, model)
        if model.owed:
            model.wanted_by = wanted_by
        else:
            self._revoke(model)

    def _revoke(self, model: _Model) -> None:
        push = RevokePush(model.id, Token(1, self._serial), "", 0.0, len(model.uses), park=False)
        self._out.append(Push(model.client, push))

    def _served(self, model: _Model) -> None:
        model.owed = False
        if model.wanted_by is not None:
            model.wanted_by = None
            self._revoke(model)

    def _gone(self, lease: LeaseId) -> None:
        self._models.pop(lease, None)

    @abstractmethod
    def _serve(self) -> None:
        """Decide which model loads and which one is revoked."""


class Unmanaged(Rules):
    """No decision: every model loads at once."""

    def _serve(self) -> None:
        for model in list(self._queue):
            self._load(model)


class OllamaRules(Rules):
    """ollama: one pending request at a time."""

    def __init__(self, gpu: GpuInfo) -> None:
        super().__init__(gpu)
        self._leaving: _Model | None = None
        self._released_at: float | None = None  # it has gone; its memory is awaited
        self._used_before = 0

    def _gone(self, lease: LeaseId) -> None:
        super()._gone(lease)
        if self._leaving is not None and self._leaving.id == lease:
            self._released_at = self._now

    def _serve(self) -> None:
        if self._leaving is not None and not self._recovered(self._leaving):
            return
        if not self._queue:
            return
        head = self._queue[0]
        if any(model.state == "loading" for model in self._models.values()):
            return  # loads are not mixed; the end of this one returns here
        free = self._gpu.capacity_bytes - max(
            self._used_bytes,
            sum(model.spec.footprint.steady_bytes for model in self._models.values()),
        )
        if not self._models or (
            len(self._models) < OLLAMA_MODELS and head.spec.footprint.steady_bytes <= free
        ):
            self._load(head)
            self._out.append(Sample(self._gpu.id))
            return
        idle = [model for model in self._models.values() if not model.uses and not model.owed]
        self._leaving = (idle or list(self._models.values()))[0]
        self._released_at, self._used_before = None, self._used_bytes
        self._ask(self._leaving, head)

    def _recovered(self, model: _Model) -> bool:
        """Return whether 80 % of the estimate is back, or the time is over; checked four times a
        second."""
        if self._released_at is None:
            return False
        enough = (
            self._used_before - self._used_bytes
            > OLLAMA_RECOVERED * model.spec.footprint.steady_bytes
        )
        if enough or self._now - self._released_at >= OLLAMA_PATIENCE_S:
            self._leaving = None
            return True
        if self._timer is None:
            self._timer = self._now + OLLAMA_POLL_S
            self._out.append(Sample(self._gpu.id))
        return False


class LlamaSwapRules(Rules):
    """llama-swap: one model at a time."""

    def _serve(self) -> None:
        if not self._queue:
            return
        if not self._models:
            self._load(self._queue[0])
            return
        present = next(iter(self._models.values()))
        if present.state == "held" and not self._queue[0].evicted:
            self._ask(present, self._queue[0])


RULES: Mapping[str, Callable[[GpuInfo], Rules]] = {
    "unmanaged": Unmanaged,
    "ollama_rules": OllamaRules,
    "llama_swap_rules": LlamaSwapRules,
}


def run(scenario: Scenario, rules: str = "") -> Outcome:
    """Simulate a scenario under the engine, or under another program's rules: there models are
    processes that end."""
    if rules:
        return World(scenario, RULES[rules](scenario.gpu), rules, holders_exit=True).run()
    engine = Arbiter(Settings(epoch=1, gpus=(scenario.gpu,)), START_S)
    return World(scenario, engine, "vram-arbiter", holders_exit=False).run()


def main() -> None:
    parser = argparse.ArgumentParser(description="The engine beside other programs' rules.")
    parser.add_argument("scenarios", metavar="SCENARIO", nargs="*", default=[*SCENARIOS])
    for name in parser.parse_args().scenarios:
        scenario = SCENARIOS[name]
        outcomes = [run(scenario, rules) for rules in ("", *RULES)]
        print(f"{name}: {scenario.about}\n{table(outcomes)}\n")


if __name__ == "__main__":
    main()
