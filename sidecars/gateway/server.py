"""One model server: the requests that wait for it, and its program, which comes and goes.

    away → queued → starting → ready → leaving → away

A request that waits lets the program be started, or woken. The program's lease is in use from the
first request in flight to the last, so the arbiter knows what is in flight: an eviction waits for
it, and it is ended after `grace_s`. Evicted with no request waiting, the program stays away.

Requests share a use: one each would cost the arbiter as much as the gateway itself takes.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from typing import Final, Literal

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncForeignUse
from vram_arbiter.schemas.config.gateway import ServerConfig
from vram_arbiter.schemas.errors import (
    ConfigError,
    Evicted,
    LeaseLost,
    LeaseRevoking,
    LimitExceeded,
    SidecarUnavailable,
    StaleToken,
    UnknownLease,
    VramError,
    WaitTimeout,
)
from vram_arbiter.sidecars.gateway.keys import Asker
from vram_arbiter.sidecars.gateway.logs import Log
from vram_arbiter.sidecars.gateway.program import ASLEEP, Program, runs_already
from vram_arbiter.sidecars.gateway.turns import Request, Turns
from vram_arbiter.sidecars.gateway.upstream import Upstream

log = logging.getLogger(__name__)

type State = Literal["away", "queued", "starting", "ready", "leaving"]

REFUSED_S: Final = 0.25
"""After a use or a connection was refused: the program reports its revoke or its end within this
time, or the revoke was withdrawn."""
LINGER_S: Final = 0.5
"""A use outlives its last request for so long, unless the program is leaving: the next request is
often there by then, and begins without a round trip to the arbiter."""
IN_FLIGHT: Final = "requests in flight"
"""Label of the use, which a waiter reads in `why`."""
BACKOFF_S, BACKOFF_MAX_S = 1.0, 60.0
"""Pause after a program died, doubled each time until a request has been served."""
WHY_S: Final = 2.0
STATES: Final[dict[str, State]] = {
    "queued": "queued",
    "loading": "starting",
    "held": "ready",
    "revoking": "leaving",
    "unloading": "leaving",
}
"""By what a program reports; it is away in any other."""


class Turn:
    """A request's turn, at a server's program. `end`: it is to end now."""

    def __init__(self, upstream: Upstream, limit: asyncio.Timeout) -> None:
        self.upstream, self._limit = upstream, limit
        self.reason = ""

    def end(self, reason: str) -> None:
        self.reason = reason
        self._limit.reschedule(asyncio.get_running_loop().time())


class Server:
    """`async with server.turn(asker) as turn: …` for each request."""

    def __init__(
        self, name: str, config: ServerConfig, client: AsyncClient, reserved: Mapping[str, int]
    ) -> None:
        self.name, self.config, self.log = name, config, Log(name)
        self.on_change: Callable[[], None] = lambda: None
        self.switches = 0
        """How often its program was started or woken."""
        self._client = client
        self._now = asyncio.get_running_loop().time
        self._turns = Turns(config.parallel, config.queue_max, reserved)
        self._begins: dict[Request, asyncio.Future[Program]] = {}
        self._current: set[Turn] = set()
        self._program: Program | None = None
        self._starting = False
        self._adopted = False  # it ran before the gateway: no request waits for its lease
        self._closed = False
        self._since = self._now()  # of its state
        self._refused_until = 0.0
        self._use: AsyncForeignUse | None = None
        self._marking = asyncio.Lock()
        self._failures, self._not_before = 0, 0.0
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    # -- what it is
    @property
    def state(self) -> State:
        if self._program is None:
            return "starting" if self._starting else "away"
        return STATES.get(self._program.state, "away")

    @property
    def waiting(self) -> int:
        return self._turns.waiting

    @property
    def in_flight(self) -> int:
        return self._turns.running

    @property
    def gpu(self) -> str:
        return "" if self._program is None else self._program.gpu

    async def why(self) -> str:
        """Return why its requests wait, in the arbiter's words where it is the arbiter's matter."""
        if self.state == "queued":
            try:
                async with asyncio.timeout(WHY_S):
                    entries = (await self._client.why(self.name)).leases
                if told := [entry.text for entry in entries if entry.state == "queued"]:
                    return told[0]
            except (TimeoutError, VramError):
                pass
        counts = f"{self.in_flight} requests in flight, {self.waiting} waiting"
        return f"{self.name} has been {self.state} for {self._now() - self._since:.0f} s; {counts}"

    # -- requests
    @asynccontextmanager
    async def turn(self, asker: Asker) -> AsyncIterator[Turn]:
        """Wait until the server can take the request, and mark it in flight within the block.

        Raises: LimitExceeded, WaitTimeout, with `details.why`; SidecarUnavailable: it died; Evicted
        from within the block, after the grace; ArbiterUnreachable.
        """
        request = Request(asker.name, asker.priority, self._now())
        try:
            self._turns.enter(request)
        except LimitExceeded as error:
            error.details["why"] = await self.why()
            raise
        self._cancel("idle")
        turn: Turn | None = None
        try:
            program = await self._begun(request)
            async with asyncio.timeout(None) as limit:
                turn = Turn(program.upstream, limit)
                self._current.add(turn)
                try:
                    yield turn
                    self._failures = 0
                finally:
                    self._current.discard(turn)
        except TimeoutError as error:
            if turn is not None and limit.expired():
                raise Evicted(turn.reason, hint="send the request again") from error
            raise
        except SidecarUnavailable as error:
            error.details.setdefault("log", self.log.tail())
            raise
        finally:
            self._turns.leave(request, self._now())
            self._begins.pop(request, None)
            self._advance()

    async def _begun(self, request: Request) -> Program:
        """Wait for the request's turn, with the program in use."""
        try:
            async with asyncio.timeout(self.config.wait_s):
                while True:
                    begins = self._begins[request] = asyncio.get_running_loop().create_future()
                    self._advance()
                    program: Program = await begins
                    try:
                        await self._mark(program)
                        return program
                    except (LeaseRevoking, LeaseLost, StaleToken, UnknownLease):
                        self._turns.put_back(request, self._now())
                        self.refused()
        except TimeoutError:
            raise WaitTimeout(
                f"waited {self.config.wait_s:g} s for {self.name}",
                hint="try again later",
                details={"why": await self.why()},
            ) from None

    async def _mark(self, program: Program) -> None:
        """Begin a use of the program's lease, unless there is one. Raises what refuses it."""
        async with self._marking:
            use = self._use
            if use is None or use.token != program.token or use.lost is not None:
                self._use = await self._client.begin_use(program.lease_id, program.token, IN_FLIGHT)

    def _end_use(self) -> None:
        if self._use is not None and not self.in_flight:
            self._spawn(self._use.end())
            self._use = None

    def refused(self) -> None:
        """Note that a use was refused, or a connection: its program is about to report why."""
        self._refused_until = self._now() + REFUSED_S
        self._after("refused", REFUSED_S, self._advance)

    # -- its program
    def unload(self) -> None:
        """Let it leave the GPU after the requests in flight."""
        if self._program is not None:
            self._program.rest()

    async def adopt(self) -> None:
        """Lease a unit or container that runs already, so that it can be evicted."""
        try:
            self._adopted = await asyncio.to_thread(runs_already, self.config)
        except ConfigError as error:
            log.warning("%s: %s", self.name, error)
        self._advance()

    async def close(self) -> None:
        """End its program. Returns when it has ended."""
        self._closed = True
        for what in list(self._timers):
            self._cancel(what)
        if self._program is not None:
            self._program.end()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _advance(self) -> None:
        """Do what is due after any change."""
        self.on_change()
        program, now = self._program, self._now()
        if self._closed:
            return
        if self._use is not None and not self.in_flight:
            if program is None or program.leaves:
                self._end_use()
            else:
                self._after("use", LINGER_S, self._end_use)
        if program is None:
            if (self.waiting or self._adopted) and not self._starting:
                if now < self._not_before:
                    self._after("restart", self._not_before - now, self._advance)
                else:
                    self._starting = True
                    self._spawn(self._run())
        elif program.state == "held":
            while now >= self._refused_until and (request := self._turns.next(now)) is not None:
                if not (begins := self._begins[request]).done():  # else its client has left
                    begins.set_result(program)
            if not self.in_flight and not self.waiting and self.config.idle_s is not None:
                self._after("idle", self.config.idle_s, self._idle)
        elif self.waiting and (program.state in ASLEEP or not program.granted):
            program.want()
        elif program.state == "queued" and not (self.waiting or program.granted or self._adopted):
            program.end()  # give up its place: no request waits

    def _changed(self) -> None:
        """Note that the program reported a state."""
        program = self._program
        if program is None:
            return
        self._since = self._now()
        self._refused_until = 0.0
        self._adopted = self._adopted and not program.granted
        if program.state == "loading":
            self.switches += 1
        if program.leaves and self._current:
            reason = f"{self.name} was evicted: {program.reason}"
            self._after("grace", self.config.grace_s, lambda: self._abort(reason))
        elif program.state == "held":
            self._cancel("grace")
        self._advance()

    def _abort(self, reason: str) -> None:
        for turn in list(self._current):
            turn.end(f"{reason}; the request was still in flight after {self.config.grace_s:g} s")

    def _idle(self) -> None:
        if not self.in_flight and not self.waiting:
            log.info("%s was idle for %g s", self.name, self.config.idle_s)
            self.unload()

    async def _run(self) -> None:
        """Start a program, and see it to its end."""
        try:
            self._program = await Program.start(
                self.name, self.config, self._client.endpoint, self.log, self._changed
            )
        except OSError as error:
            self._failed(f"{self.name} cannot be started: {error.strerror}")
            return
        finally:
            self._starting = False
        self._since = self._now()
        program = self._program
        self._advance()
        code = await program.wait()
        self._program, self._since, self._adopted = None, self._now(), False
        self._cancel("grace")
        if not program.leaves:
            self._failed(f"{self.name} ended with exit code {code}")
        self._advance()

    def _failed(self, what: str) -> None:
        """Let its waiting requests fail, and pause before it is started again."""
        pause_s = min(BACKOFF_S * 2**self._failures, BACKOFF_MAX_S)
        self._failures += 1
        self._not_before = self._now() + pause_s
        log.error("%s; it is started again in %g s at the earliest", what, pause_s)
        error = SidecarUnavailable(
            what,
            hint="see /logs",
            details={"log": self.log.tail(), "retry_in_s": pause_s},
        )
        for request in self._turns.all_waiting():
            begins = self._begins.get(request)
            if begins is not None and not begins.done():
                begins.set_exception(error)

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _after(self, what: str, seconds: float, then: Callable[[], None]) -> None:
        """Call `then` once, unless it is to be called already."""
        if what not in self._timers:

            def due() -> None:
                del self._timers[what]
                then()

            self._timers[what] = asyncio.get_running_loop().call_later(seconds, due)

    def _cancel(self, what: str) -> None:
        if (timer := self._timers.pop(what, None)) is not None:
            timer.cancel()
