"""Signals that `vramctl run` passes on to its program: from before it starts, so that none ends
`vramctl` while it runs."""

import asyncio
import signal
import threading
from collections.abc import Callable
from typing import Self

from vram_arbiter.clients.foreign.program import Program

FORWARDED = (
    signal.SIGTERM,
    signal.SIGHUP,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGCONT,
    signal.SIGWINCH,
)
TYPED = frozenset({signal.SIGINT, signal.SIGQUIT})
r"""A terminal sends these to the program as well (Ctrl-C, Ctrl-\): they are passed on only when a
process sent them."""
ENDING = TYPED | {signal.SIGTERM, signal.SIGHUP}
"""Signals that ask the program to end."""
SI_KERNEL = 128


class Forwarding:
    """`with Forwarding(...) as signals`, start a program, then `signals.to(it)`; again for its
    successor.

    `asked_to_end` is called with each signal of ENDING, whether a program runs or not.
    """

    def __init__(self, asked_to_end: Callable[[signal.Signals], None]) -> None:
        self._asked_to_end = asked_to_end
        self._program: Program | None = None
        self._early: list[signal.Signals] = []
        self._over = False
        self._loop = asyncio.get_running_loop()
        # Only sigwaitinfo says where a signal is from, and only in a thread does it not block the
        # loop.
        self._listener = threading.Thread(target=self._listen, name="signals", daemon=True)

    def __enter__(self) -> Self:
        for number in (*FORWARDED, *TYPED):
            self._loop.add_signal_handler(number, self._heard, number)
        return self

    def to(self, program: Program) -> None:
        """It has started. Signals of its terminal are blocked here from now on."""
        self._program = program
        if self._listener.ident is None:
            signal.pthread_sigmask(signal.SIG_BLOCK, TYPED)
            self._listener.start()
        early, self._early = self._early, []
        for number in early:
            self._forward(number)

    def __exit__(self, *_: object) -> None:
        if self._listener.ident is not None:
            self._over = True
            signal.pthread_kill(self._listener.ident, signal.SIGINT)
            self._listener.join()
            signal.pthread_sigmask(signal.SIG_UNBLOCK, TYPED)
        for number in (*FORWARDED, *TYPED):
            self._loop.remove_signal_handler(number)

    def _listen(self) -> None:
        while True:
            found = signal.sigwaitinfo(TYPED)
            if self._over:
                return
            number = signal.Signals(found.si_signo)
            typed = found.si_code == SI_KERNEL
            self._loop.call_soon_threadsafe(self._asked_to_end if typed else self._heard, number)

    def _heard(self, number: signal.Signals) -> None:
        if number in ENDING:
            self._asked_to_end(number)
        self._forward(number)

    def _forward(self, number: signal.Signals) -> None:
        if self._program is None:
            self._early.append(number)
        else:
            self._program.send_signal(number)
