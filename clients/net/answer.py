"""The answer to one request, and a time limit that counts only the time in which this process ran.

A loop that stood still (an import, SIGSTOP, a busy machine) finds the answer and the end of its
time limit at once. The module must not know what is asked.
"""

from typing import Final, cast

import anyio

HELD_UP_S: Final = 0.1
"""A timer that is later than this shows that the process did not run; a working loop is late by
milliseconds."""


class Answer[T]:
    """A value or an error that is set once. The first one set counts."""

    def __init__(self) -> None:
        self._event = anyio.Event()
        self._value: T | None = None
        self._error: BaseException | None = None

    @property
    def done(self) -> bool:
        return self._event.is_set()

    @property
    def failed(self) -> bool:
        return self._error is not None

    def set(self, value: T) -> None:
        if not self._event.is_set():
            self._value = value
            self._event.set()

    def fail(self, error: BaseException) -> None:
        if not self._event.is_set():
            self._error = error
            self._event.set()

    def result(self) -> T:
        """Return the value, or raise the error. Only once it is `done`."""
        assert self.done, "not answered yet"
        if self._error is not None:
            raise self._error
        return cast(T, self._value)

    async def wait(self) -> T:
        await self._event.wait()
        return self.result()

    async def within(self, timeout_s: float) -> T:
        """Wait for at most `timeout_s` seconds in which this process ran.

        An answer that is there by then counts. A process that stood still waits as long again, at
        most `timeout_s`: what arrived meanwhile is not read yet.

        Raises: TimeoutError, or the answer's error.
        """
        deadline = anyio.current_time() + timeout_s
        with anyio.move_on_after(timeout_s):
            await self._event.wait()
        late_s = anyio.current_time() - deadline
        if not self.done and late_s > HELD_UP_S:
            with anyio.move_on_after(min(late_s, timeout_s)):
                await self._event.wait()
        if not self.done:
            raise TimeoutError
        return self.result()
