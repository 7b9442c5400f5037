"""Leases as rows of `vramctl top`: columns by width, order, and what a waiter waits for.

Pure. Words of reasons and estimates are the arbiter's own (`StatusReply.details`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf

from rich.cells import cell_len, set_cell_size

from vram_arbiter.clients.cli.text import duration
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.wire.explained import LeaseDetail
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import LeaseView

INDENT = "  └ "
CONSUMER_MIN = 10
ROOMY = 100
"""From this width on columns are two cells apart."""


@dataclass(frozen=True, slots=True)
class Row:
    """One lease as it is shown and sorted."""

    lease: LeaseView
    detail: LeaseDetail | None
    tier: str  # "GPU 0", "RAM" or "-"

    @property
    def eta_s(self) -> float | None:
        """Seconds until a waiter is loaded; None: unknown, or it does not wait."""
        why = None if self.detail is None else self.detail.why
        return None if why is None else why.eta_s

    @property
    def declared_bytes(self) -> int:
        return 0 if self.detail is None else self.detail.declared_bytes

    @property
    def measured_bytes(self) -> int | None:
        return None if self.detail is None else self.detail.measured_bytes

    @property
    def reason(self) -> str:
        """What a waiter, or a lease that is away, waits for."""
        why = None if self.detail is None else self.detail.why
        return "" if why is None else printable(why.next)

    @property
    def state(self) -> str:
        lease = self.lease
        if lease.position is not None:
            return f"{lease.state} #{lease.position}"
        return lease.state if lease.evictable else f"{lease.state} pin"

    @property
    def since_s(self) -> float:
        """Seconds since the grant of a lease with bytes, else since it waits or left."""
        lease = self.lease
        away = lease.state in ("queued", "standby", "parked") or lease.granted_s is None
        return lease.since_s if away else lease.granted_s or 0.0


def rows_of(status: StatusReply) -> list[Row]:
    """Return the leases in the arbiter's order: granted by arrival, then the queue."""
    details = {detail.lease_id: detail for detail in status.details}
    indices = {gpu.gpu: gpu.index for gpu in status.gpus}
    return [Row(one, details.get(one.lease_id), _tier(one, indices)) for one in status.leases]


def _tier(lease: LeaseView, indices: Mapping[str, int]) -> str:
    """Return where the weights are: on a GPU, parked in host RAM, or unloaded."""
    if lease.state == "parked":
        return "RAM"
    if lease.gpu is None or lease.state in ("queued", "standby"):
        return "-"
    return f"GPU {indices[lease.gpu]}" if lease.gpu in indices else "GPU"


# -- order
ORDERS: Mapping[str, Callable[[Row], tuple[float, str]]] = {
    "queue": lambda row: (0.0, ""),  # the arbiter's order stays
    "consumer": lambda row: (0.0, row.lease.consumer),
    "charged": lambda row: (-row.lease.charge_bytes, row.lease.consumer),
    "measured": lambda row: (-(row.measured_bytes or 0), row.lease.consumer),
    "uses": lambda row: (-row.lease.uses, row.lease.consumer),
    "priority": lambda row: (-row.lease.priority, row.lease.consumer),
    "eta": lambda row: (inf if row.eta_s is None else row.eta_s, row.lease.consumer),
    "since": lambda row: (-row.since_s, row.lease.consumer),
}
"""Orders by name; the key `s` takes the next one."""


# -- columns
def brief_bytes(count: int | None) -> str:
    """`5.33 GiB`, `450 MiB`, `0`: at most eight cells up to 9,999 GiB; `?` where it is unknown."""
    if count is None:
        return "?"
    if count >= GIB:
        return f"{count / GIB:.2f} GiB" if count < 1000 * GIB else f"{count / GIB:.0f} GiB"
    return f"{count / MIB:.0f} MiB" if count else "0"


@dataclass(frozen=True, slots=True)
class Column:
    """One column. `width` 0: it takes what is left. `least`: terminal width that shows it."""

    title: str
    width: int
    cell: Callable[[Row], str]
    least: int = 0
    right: bool = True


def _eta(row: Row) -> str:
    if row.eta_s is not None:
        return duration(row.eta_s)
    return "?" if row.lease.state == "queued" else ""


COLUMNS: Sequence[Column] = (
    Column("LEASE", 18, lambda row: row.lease.lease_id, 140, right=False),
    Column("CONSUMER", 0, lambda row: row.lease.consumer, right=False),
    Column("MODEL", 18, lambda row: row.lease.model, 120, right=False),
    Column("STATE", 11, lambda row: row.state, right=False),
    Column("TIER", 6, lambda row: row.tier, 70, right=False),
    Column("DECLARED", 8, lambda row: brief_bytes(row.declared_bytes), 70),
    Column("CHARGED", 8, lambda row: brief_bytes(row.lease.charge_bytes)),
    Column("MEASURED", 8, lambda row: _measured(row)),
    Column("USES", 4, lambda row: str(row.lease.uses)),
    Column("PRIO", 4, lambda row: str(row.lease.priority), 100),
    Column("PID", 7, lambda row: str(row.lease.pid), 132),
    Column("SINCE", 6, lambda row: duration(row.since_s), 100),
    Column("ETA", 6, _eta),
)


def _measured(row: Row) -> str:
    return brief_bytes(row.measured_bytes) if row.tier.startswith("GPU") else ""


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of one terminal width, and how a row is laid out in them."""

    width: int

    @property
    def columns(self) -> list[Column]:
        return [column for column in COLUMNS if self.width >= column.least]

    def head(self) -> str:
        return self._line([column.title for column in self.columns])

    def line(self, row: Row) -> str:
        return self._line([printable(column.cell(row)) for column in self.columns])

    def reason(self, row: Row) -> str:
        """Return the second line of a waiter, cut to the width; "" for every other lease."""
        return fitted(INDENT + row.reason, self.width) if row.reason else ""

    def _line(self, cells: Sequence[str]) -> str:
        columns, gap = self.columns, "  " if self.width >= ROOMY else " "
        fixed = sum(column.width for column in columns) + len(gap) * (len(columns) - 1)
        rest = max(CONSUMER_MIN, self.width - fixed)
        shown = []
        for column, cell in zip(columns, cells, strict=True):
            room = column.width or rest
            text = fitted(cell, room)
            pad = " " * (room - cell_len(text))
            shown.append(pad + text if column.right else text + pad)
        return gap.join(shown)


def fitted(text: str, width: int) -> str:
    """Return the text, cut with an ellipsis where it is wider than `width` cells."""
    return text if cell_len(text) <= width else set_cell_size(text, max(0, width - 1)) + "…"
