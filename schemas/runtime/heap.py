"""The C library's heap of a server that reads large messages, and Python's while it starts."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # <malloc.h>
_THRESHOLD_BYTES: Final = 128 * 1024


def give_back_freed_memory() -> None:
    """Let malloc return large buffers to the kernel when they are freed, for the rest of this
    process.

    glibc raises its threshold for mmap (mallopt(3), M_MMAP_THRESHOLD) with every large buffer that
    is freed, up to 32 MiB, and keeps what lies below it: after one attack with incomplete messages
    the daemon stayed at 136 MiB; with fixed thresholds it is back at 29. Without effect on another
    C library.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _THRESHOLD_BYTES)


@contextmanager
def without_collections() -> Iterator[None]:
    """Make objects that all stay: the search for garbage is a tenth of the imports' time."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
