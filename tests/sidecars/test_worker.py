"""The thread that touches the model."""

import asyncio
import weakref

import pytest

from schemas.errors import ModelError, VramError
from sidecars.worker import Worker


class Weights:
    """Stands for a gigabyte on the GPU."""


@pytest.mark.parametrize("typed", [False, True])
def test_a_failed_load_keeps_none_of_what_it_loaded(typed: bool) -> None:
    """The sidecar remembers its last error, and an error's traceback keeps the locals of every frame: the memory would not come back."""
    held: list[weakref.ref[Weights]] = []

    def load() -> None:
        half = Weights()
        held.append(weakref.ref(half))
        try:
            raise ValueError("half of the file is missing")
        except ValueError as error:
            if typed:
                raise ModelError("incomplete") from error
            raise

    async def fail() -> VramError:
        worker = Worker()
        try:
            await worker.run(load)
        except VramError as error:
            return error
        finally:
            worker.close()
        raise AssertionError("it did not fail")

    error = asyncio.run(fail())
    assert isinstance(error, ModelError)
    assert held[0]() is None
