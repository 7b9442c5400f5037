"""Identifiers that the whole product shares.

Standard library only: this is the one schema module that the sans-IO core may import besides
`schemas.defaults`.
"""

from typing import NamedTuple, NewType

LeaseId = NewType("LeaseId", str)
"""Names one lease for ever, e.g. `L3-17` (epoch 3, serial 17)."""

GpuId = NewType("GpuId", str)
"""UUID of a GPU as its driver reports it, e.g. `GPU-5b6c…`."""

ClientId = NewType("ClientId", str)
"""Names one connection to the arbiter (the hex of its ZeroMQ routing id)."""

UseId = NewType("UseId", str)
"""Names one busy interval on a lease; chosen by the client that begins it."""

RequestId = NewType("RequestId", int)
"""Counts the requests of one connection; replies repeat it."""


class Token(NamedTuple):
    """Fencing token. Strictly increasing over all grants, also across restarts of the daemon.

    `epoch` counts starts of the daemon, `serial` counts grants within an epoch.
    Its plain form is `[epoch, serial]` (`schemas.codec`).
    """

    epoch: int
    serial: int

    def __str__(self) -> str:
        return f"{self.epoch}.{self.serial}"


class ProcessKey(NamedTuple):
    """One process forever: a pid alone is reused, a pid with its start time is not.

    `start_ticks` is field 22 of /proc/PID/stat (clock ticks since boot). A tuple, because tables
    are keyed by processes everywhere.
    """

    pid: int
    start_ticks: int

    def __str__(self) -> str:
        return f"{self.pid}@{self.start_ticks}"
