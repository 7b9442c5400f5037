"""Work beside a test, on asyncio and trio alike: started, awaited, canceled. Not a test module."""

from collections.abc import AsyncIterator, Callable, Coroutine, Generator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from anyio.abc import TaskGroup

from vram_arbiter.clients.net.answer import Answer

type Start = Callable[[Coroutine[Any, Any, Any]], "Beside[Any]"]


class Canceled(Exception):
    """What awaiting canceled work raises."""


class Beside[T]:
    """One coroutine in a task of its own. Awaiting it gives its result, or raises its error."""

    def __init__(self, tasks: TaskGroup, work: Coroutine[Any, Any, T]) -> None:
        self._work = work
        self._scope = anyio.CancelScope()
        self._end: Answer[T] = Answer()
        tasks.start_soon(self._run)

    @property
    def done(self) -> bool:
        return self._end.done

    def cancel(self) -> None:
        self._scope.cancel()

    def __await__(self) -> Generator[Any, Any, T]:
        return self._end.wait().__await__()

    async def _run(self) -> None:
        try:
            with self._scope:
                self._end.set(await self._work)
        except Exception as error:  # noqa: BLE001  it is raised where the work is awaited
            self._end.fail(error)
        finally:
            self._end.fail(Canceled())


@asynccontextmanager
async def within(longest_s: float) -> AsyncIterator[None]:
    """Raise TimeoutError if the block takes longer."""
    with anyio.fail_after(longest_s):
        yield
