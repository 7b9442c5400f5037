"""Readings of the GPUs without ever blocking the loop: one thread per GPU, each reading with a
deadline.

A reading that fails or hangs is *unknown*. A thread that hangs cannot be ended, so the GPU stays
unknown and no further reading is started until it returns. Requests are merged, except that one
that comes after a reading began is answered by a fresh one: a verification must never be fed with a
reading from before its question. Bytes of children, units and containers are booked on the holder
of their lease (`process_tree`): /proc is read in the thread, holders are looked up when the reading
is handed on.
"""

import asyncio
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence, Set
from typing import Literal

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.host.gpu.probe import GpuProbe, Reading
from vram_arbiter.arbiter.host.process_tree import Claims, Lineage, Lineages, on_owners
from vram_arbiter.schemas.errors import ProbeFailed
from vram_arbiter.schemas.ids import GpuId, ProcessKey

log = logging.getLogger(__name__)

CLOSE_S = 1.0


class Prober:
    """`sample(gpu)` ends by posting `MemorySampled` or `ProbeFailed`, exactly one for a request or
    for several merged ones.

    `owners(gpu)` and `clients()` are processes with an account on the GPU, and with a connection;
    `claims(gpu)` are the cgroups that leases name. They are called on the loop's thread.
    """

    def __init__(
        self,
        probe: GpuProbe,
        gpus: Sequence[GpuId],
        deadline_s: float,
        loop: asyncio.AbstractEventLoop,
        post: Callable[[ev.Event], None],
        owners: Callable[[GpuId], Set[ProcessKey]],
        clients: Callable[[], Set[ProcessKey]],
        claims: Callable[[GpuId], Claims],
    ) -> None:
        self.probe = probe
        self.deadline_s = deadline_s
        self.loop = loop
        self.post = post
        self.owners = owners
        self.clients = clients
        self.claims = claims
        self._readers = {gpu: _Reader(self, gpu) for gpu in gpus}

    def sample(self, gpu: GpuId) -> None:
        """Read a GPU now, or again after the reading under way, which began before this
        question."""
        reader = self._readers[gpu]
        match reader.state:
            case "idle":
                reader.begin()
            case "reading":
                reader.again = True
            case "stuck":
                reader.tell_again()
            case "closed":
                pass

    def close(self) -> None:
        """Ends the threads. A call that hangs in its driver is not waited for: it dies with the
        process (daemon threads)."""
        for reader in self._readers.values():
            reader.close()
        closing = threading.Thread(target=self.probe.close, name="probe-close", daemon=True)
        closing.start()
        closing.join(CLOSE_S)


class _Reader:
    """One GPU: idle → reading → idle, or reading → stuck → idle when the hung call returns at
    last."""

    def __init__(self, prober: Prober, gpu: GpuId) -> None:
        self._prober = prober
        self._loop = prober.loop
        self._gpu = gpu
        self._lineages = Lineages()  # the thread's
        self.state: Literal["idle", "reading", "stuck", "closed"] = "idle"
        self.again = False
        """A question came after the reading under way began."""
        self._timer: asyncio.TimerHandle | None = None
        self._began_at = 0.0
        self._work: queue.SimpleQueue[bool] = queue.SimpleQueue()  # True: read, False: end
        self._thread: threading.Thread | None = None

    def tell_again(self) -> None:
        """Say once more that the reading hangs, after a while: no busy loop of questions and
        refusals."""
        self.again = True
        if self._timer is None:
            self._timer = self._loop.call_later(self._prober.deadline_s, self._still_stuck)

    def close(self) -> None:
        self.state = "closed"
        if self._timer is not None:
            self._timer.cancel()
        self._work.put(False)

    def begin(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._run, name=f"probe-{self._gpu}", daemon=True
            )
            self._thread.start()
        self.state, self.again = "reading", False
        self._began_at = time.monotonic()
        self._timer = self._loop.call_later(self._prober.deadline_s, self._expired)
        self._work.put(True)

    def _expired(self) -> None:
        self._timer = None
        self.state = "stuck"
        late = f"no answer within {self._prober.deadline_s:g} s"
        log.error("%s: %s; unknown until the reading returns", self._gpu, late)
        self._fail(late)

    def _still_stuck(self) -> None:
        self._timer = None
        self._fail(f"the reading hangs since {time.monotonic() - self._began_at:.1f} s")

    def _fail(self, reason: str) -> None:
        self._prober.post(ev.ProbeFailed(self._gpu, time.monotonic(), reason))

    def _done(
        self, taken_at: float, outcome: Reading | str, lineages: Mapping[ProcessKey, Lineage]
    ) -> None:
        """Back on the loop's thread. A late answer is not used: it is as old as its question, and a
        fresh one costs nothing."""
        if self.state == "closed":
            return
        was_stuck = self.state == "stuck"
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.state = "idle"
        if was_stuck:
            log.warning(
                "%s: answers again after %.1f s", self._gpu, time.monotonic() - self._began_at
            )
            self.begin()  # whether it answers is known from a fresh reading only
            return
        if isinstance(outcome, Reading):
            processes = outcome.processes
            if processes:
                prober = self._prober
                owners = prober.owners(self._gpu)
                named = {use.process for use in processes}
                if named - owners or len(named) < len(processes):
                    others = prober.clients(), prober.claims(self._gpu)
                    processes = on_owners(processes, lineages, owners, *others)
            self._prober.post(
                ev.MemorySampled(
                    self._gpu, taken_at, outcome.used_bytes, outcome.total_bytes, processes
                )
            )
        else:
            self._fail(outcome)
        if self.again and self.state == "idle":
            # else the handler of this answer asked again, and that reading serves all
            self.begin()

    # -- the thread
    def _run(self) -> None:
        while self._work.get():
            taken_at = time.monotonic()
            outcome: Reading | str
            lineages: Mapping[ProcessKey, Lineage] = {}
            try:
                outcome = self._prober.probe.sample(self._gpu)
                lineages = self._lineages.trace(outcome.processes or ())
            except ProbeFailed as error:
                outcome = error.message
            except Exception as error:  # outermost loop of a thread: a defect is an unknown GPU
                log.exception("%s: the probe failed", self._gpu)
                outcome = f"{type(error).__name__}: {error}"
            try:
                self._loop.call_soon_threadsafe(self._done, taken_at, outcome, lineages)
            except RuntimeError:
                return  # the loop closed meanwhile
