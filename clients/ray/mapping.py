"""Numbered calls over actors of Ray: each seed has a result, which counts once, or a named failure.

A call is sent once; after a death or its deadline its seed goes to another actor. Ray restarts the
dead (`max_restarts=-1`). It gives no error of a process that stands still, so that each call has a
deadline, and the actor is killed at its end. Before each seed an actor is asked for its node: one
that is being restarted is given none.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.ray.residency import Refused
from vram_arbiter.clients.results import commit, committed
from vram_arbiter.schemas.errors import TransientError

ATTEMPTS_MAX: Final = 3
"""A seed whose actor dies so often, or is late, is the cause of it."""
AWAY_MAX_S: Final = 120.0
"""Beside a call's deadline, how long all actors may be refused or not answer: a node's death is
noticed within 30 s, and a busy machine starts an actor within a minute."""
PAUSE_S: Final = 0.5
"""Before an actor that failed is asked again."""
NAMED_MAX: Final = 10
"""Seeds that the error's text names; its details name all."""
TOLD_MAX_CHARS: Final = 200


@dataclass(frozen=True, slots=True)
class Result:
    """What the call of a seed returned, and the Ray node that it ran on."""

    seed: int
    node: str
    value: Any


class SeedsFailed(TransientError):
    """Seeds have no result, when all others have one: `details.failed` says why, by seed."""


class Seeds:
    """Seeds that have no result yet. Pure."""

    def __init__(self, seeds: Iterable[int], done: Iterable[int]) -> None:
        left_out = set(done)
        self.failed: dict[int, str] = {}
        self._left = deque(seed for seed in dict.fromkeys(seeds) if seed not in left_out)
        self._attempts = Counter[int]()

    def __bool__(self) -> bool:
        return bool(self._left)

    def take(self) -> int:
        return self._left.popleft()

    def give_back(self, seed: int) -> None:
        """Queue a seed whose call did not begin."""
        self._left.appendleft(seed)

    def lost(self, seed: int, why: str) -> None:
        """Queue a seed whose actor died or was late, at the end, until it has failed too often."""
        self._attempts[seed] += 1
        if self._attempts[seed] < ATTEMPTS_MAX:
            self._left.append(seed)
        else:
            self.failed[seed] = f"{why} ({ATTEMPTS_MAX} times)"

    def strand(self, why: str) -> None:
        """Fail all that are left."""
        self.failed |= dict.fromkeys(self._left, why)
        self._left.clear()

    def check(self) -> None:
        """Raise SeedsFailed for those that failed."""
        if self.failed:
            told = [f"{seed}: {why}" for seed, why in sorted(self.failed.items())]
            raise SeedsFailed(
                f"{len(told)} seeds have no result: {'; '.join(told[:NAMED_MAX])}",
                hint="call it again: seeds with a result are left out",
                details={"failed": {str(seed): why for seed, why in self.failed.items()}},
            )


@dataclass(slots=True, eq=False)
class _Worker:
    """One actor and what it was sent: a seed, or (`seed` None) the question for its node."""

    actor: Any
    node: str = ""
    seed: int | None = None
    sent: Any = None
    due_at: float = 0.0
    """When the call is late; without a call: when the next one may be sent."""


def map_results(
    actors: Sequence[Any],
    method: str,
    seeds: Iterable[int],
    out: Path,
    deadline_s: float,
    on_result: Callable[[Result], object] | None = None,
) -> Iterator[Result]:
    """Yield the results of `actor.method(seed)`, as they come, each committed to `out` before.

    Seeds with a result in `out` are left out: the same call again goes on. An actor has one call
    at a time; one that is listed twice has two.

    Raises: SeedsFailed at the end, if seeds have no result: what the method raised, or what befell
        its actors.
    """
    left, workers = Seeds(seeds, committed(out)), [_Worker(actor) for actor in actors]
    for result in _Mapping(workers, method, left, out, deadline_s).run():
        if on_result is not None:
            on_result(result)
        yield result
    left.check()


@dataclass(slots=True)
class _Mapping:
    workers: Sequence[_Worker]
    method: str
    seeds: Seeds
    out: Path
    deadline_s: float
    ended_at: float = field(default_factory=time.monotonic)
    """When a seed ended last, and did not just go back."""
    last_seen: str = "there is none"

    def run(self) -> Iterator[Result]:
        away_max_s = AWAY_MAX_S + self.deadline_s
        while self.seeds or any(worker.seed is not None for worker in self.workers):
            if not self.workers or time.monotonic() - self.ended_at > away_max_s:
                self.seeds.strand(f"no actor answers: {self.last_seen}")
                return
            for worker in self.workers:
                if worker.sent is None and self.seeds and time.monotonic() >= worker.due_at:
                    self._send(worker, "__ray_call__", _node, away_max_s)
            for worker, answered in self._ended():
                if not answered:
                    self._late(worker)
                elif (result := self._answer(worker)) is not None:
                    yield result
                    self.ended_at = time.monotonic()  # the caller may have taken its time

    # -- steps
    def _send(self, worker: _Worker, method: str, argument: object, within_s: float) -> None:
        worker.sent = getattr(worker.actor, method).options(max_task_retries=0).remote(argument)
        worker.due_at = time.monotonic() + within_s

    def _ended(self) -> list[tuple[_Worker, bool]]:
        """Wait for an answer, a deadline or the end of a pause; return whose call has ended, and
        whether by an answer."""
        import ray

        asked = [worker for worker in self.workers if worker.sent is not None]
        wakes = [worker.due_at for worker in self.workers if worker.sent or self.seeds]
        wait_s = max(0.0, min(wakes) - time.monotonic())
        if not asked:
            time.sleep(wait_s)
            return []
        calls = [worker.sent for worker in asked]
        ray.wait(calls, timeout=wait_s)
        answers, _ = ray.wait(calls, num_returns=len(calls), timeout=0)  # all that there are
        now = time.monotonic()
        ends = [(worker, worker.sent in answers) for worker in asked]
        return [(worker, answered) for worker, answered in ends if answered or worker.due_at <= now]

    def _answer(self, worker: _Worker) -> Result | None:
        """What a body raises is not tried again: its seed fails."""
        from ray import exceptions, get

        seed, worker.seed = worker.seed, None
        sent, worker.sent = worker.sent, None
        worker.due_at = 0.0
        try:
            value = get(sent)
        except exceptions.RayTaskError as error:
            if seed is None or isinstance(error.cause, Refused):
                self._rest(worker, seed, error.cause)
            else:
                self._fail(seed, error.cause)
        except exceptions.RayError as error:
            self._lost(worker, seed, error)
        else:
            if seed is not None:
                return self._committed(Result(seed, worker.node, value))
            worker.node = value
            if self.seeds:
                worker.seed = self.seeds.take()
                self._send(worker, self.method, worker.seed, self.deadline_s)
        return None

    def _late(self, worker: _Worker) -> None:
        """Kill an actor that does not answer; Ray restarts it."""
        import ray

        seed, worker.seed, worker.sent = worker.seed, None, None
        ray.kill(worker.actor, no_restart=False)
        self._lost(worker, seed, TimeoutError("no answer before the deadline"))

    def _committed(self, result: Result) -> Result | None:
        """None: it has another result already, or one that JSON cannot say."""
        self.ended_at = time.monotonic()
        try:
            return result if commit(self.out, result.seed, result.value) else None
        except (TypeError, ValueError) as error:
            self._fail(result.seed, error)
            return None

    def _fail(self, seed: int, error: BaseException) -> None:
        self.ended_at = time.monotonic()
        self.seeds.failed[seed] = _told(error)

    def _lost(self, worker: _Worker, seed: int | None, error: BaseException) -> None:
        if seed is not None:
            self.ended_at = time.monotonic()
            self.seeds.lost(seed, _told(error))
        self._rest(worker, None, error)

    def _rest(self, worker: _Worker, seed: int | None, error: BaseException) -> None:
        """Let an actor pause; its seed, if it has not begun, goes back."""
        worker.due_at = time.monotonic() + PAUSE_S
        self.last_seen = _told(error)
        if seed is not None:
            self.seeds.give_back(seed)


def _node(_: Any) -> str:
    """Runs on the actor."""
    import ray

    return str(ray.get_runtime_context().get_node_id())


def _told(error: BaseException) -> str:
    """Kind and first line of an error."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:TOLD_MAX_CHARS]
