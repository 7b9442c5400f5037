"""GPUs, the arbiter and the selected lease as lines of `vramctl top`. Pure."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil

from rich.cells import cell_len

from vram_arbiter.clients.cli import text
from vram_arbiter.clients.cli.text import duration, plural
from vram_arbiter.clients.cli.top.rows import Row, brief_bytes, fitted
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import GpuView

SPAN_S = 240.0
"""Time that a sparkline shows."""
BLOCKS = "▁▂▃▄▅▆▇█"
TWO_LINES_MAX = 2
"""Up to so many GPUs have two lines each, on a terminal of at least TALL lines."""
TALL = 20
NAME_MIN = 8
"""Cells for the GPU's name; with fewer it is left out."""


@dataclass(slots=True)
class Samples:
    """Measured bytes of one GPU over the last minutes: (monotonic seconds, bytes or None)."""

    points: deque[tuple[float, int | None]] = field(default_factory=deque)

    def add(self, at_s: float, used_bytes: int | None) -> None:
        self.points.append((at_s, used_bytes))
        while self.points[0][0] < at_s - SPAN_S:
            self.points.popleft()

    def sparkline(self, width: int, capacity_bytes: int) -> str:
        """Return one block per interval, the newest at the right: the largest reading in it.

        An interval without a reading shows the one before it; a blank: none yet, or unknown.
        """
        if not self.points or width < 1:
            return " " * max(0, width)
        now, step = self.points[-1][0], SPAN_S / width
        found: dict[int, int | None] = {}
        for at_s, used in self.points:
            place = width - 1 - int((now - at_s) / step)
            if place >= 0:
                known = found.get(place)
                found[place] = used if known is None or used is None else max(known, used)
        shown, last = [], None
        for place in range(width):
            last = found.get(place, last)
            shown.append(" " if last is None else block(last, capacity_bytes))
        return "".join(shown)


def block(used_bytes: int, capacity_bytes: int) -> str:
    """Return the block of a reading; anything above 0 is at least the second lowest."""
    share = min(1.0, used_bytes / capacity_bytes) if capacity_bytes > 0 else 0.0
    return BLOCKS[ceil(share * (len(BLOCKS) - 1))]


def header(status: StatusReply, role: str, width: int) -> str:
    """Return the arbiter's state in one line, with as much of it as fits."""
    totals = status.totals
    shown = f"arbiter {status.phase}"
    for more in (
        f"{plural(totals.leases, 'lease')}, {totals.waiting} waiting",
        role,
        f"up {duration(status.uptime_s)}",
        plural(status.clients, "client"),
        f"epoch {status.epoch}",
    ):
        longer = f"{shown} · {more}"
        shown = longer if cell_len(longer) <= width else shown
    return shown


def notices(status: StatusReply) -> list[str]:
    """Return what keeps the arbiter from granting at all, and problems of its own files."""
    found = []
    if status.phase == "recovering":
        found.append("restarted: nothing is granted until every lease is accounted for")
    if status.drained:
        found.append(f"drained by {status.drained}; nothing is granted until it is resumed")
    return [printable(line) for line in [*found, *status.problems]]


def gpu_lines(gpu: GpuView, samples: Samples, width: int, *, brief: bool) -> list[str]:
    """Return a GPU in two lines, or in one where `brief`; one more says why it grants nothing
    where that does not fit in the first."""
    name, why = f"GPU {gpu.index}", "" if gpu.blocked is None else printable(gpu.blocked.text)
    used = gpu.measured_used_bytes
    size = brief_bytes
    if brief:
        numbers = f"{size(gpu.charged_bytes)} of {size(gpu.capacity_bytes)}, {size(used)} measured"
        rest = width - len(name) - len(numbers) - 4
        shown = [f"{name} {_bar(gpu, rest // 2)} {numbers} {_line(gpu, samples, rest - rest // 2)}"]
    else:
        parts = [
            name,
            f"charged {size(gpu.charged_bytes)} of {size(gpu.capacity_bytes)}",
            f"measured {size(used)}" if used is not None else "measured unknown: nothing granted",
        ]
        parts += [f"stowaways {size(gpu.stowaway_bytes)}"] if gpu.stowaway_bytes else []
        parts += [f"pressure {size(gpu.pressure_bytes)}"] if gpu.pressure_bytes else []
        known = text.sensors_text(to_map(gpu.sensors))
        told = " · ".join([*parts, known] if known else parts)
        room = width - len(told) - 3
        if 0 < len(why) <= room:
            told, why = f"{told} · {why}", ""
        elif not why and room >= NAME_MIN:
            told += f" · {fitted(printable(gpu.name), room)}"
        span = f" {SPAN_S / 60:.0f} min"
        bar = (width - len(span) - 2) // 2
        shown = [told, f"{_bar(gpu, bar)} {_line(gpu, samples, width - bar - 1 - len(span))}{span}"]
    if why:
        shown.append(f"  no grants now: {why}")
    return [fitted(line, width) for line in shown]


def _line(gpu: GpuView, samples: Samples, width: int) -> str:
    return samples.sparkline(width, gpu.capacity_bytes)


def _bar(gpu: GpuView, width: int) -> str:
    """Return charged, stowaways, free and reserve as a bar between brackets."""
    inner = max(1, width - 2)
    total = max(1, gpu.capacity_bytes)

    def cells(count: int) -> int:
        return round(inner * min(1.0, max(0, count) / total))

    charged = cells(gpu.charged_bytes)
    strange = min(inner - charged, cells(gpu.stowaway_bytes))
    kept = min(inner - charged - strange, cells(gpu.reserve_bytes))
    free = inner - charged - strange - kept
    return f"[{'█' * charged}{'▒' * strange}{'░' * free}{'·' * kept}]"


def demands(status: StatusReply, width: int, height: int) -> list[str]:
    """Return the requests at consumers; of many, those that fit into a fifth of the terminal."""
    lines = text.demand_lines([to_map(one) for one in status.demands])
    most = max(2, height // 5)
    more = [f"and {len(lines) - most + 1} more"] if len(lines) > most else []
    return [fitted(line, width) for line in [*lines[: most - len(more)], *more]]


def selected_lines(row: Row | None) -> list[str]:
    """Return what is known of the selected lease, in lines of any length."""
    if row is None:
        return []
    lease = row.lease
    told = [
        f"{lease.consumer} ({lease.lease_id}) {lease.model}, pid {lease.pid}, priority "
        f"{lease.priority}, {row.state} for {duration(lease.since_s)}"
    ]
    told += [f"pinned by {lease.pinned}"] if lease.pinned else []
    told += ["comes back by itself"] if lease.standby and row.tier.startswith("GPU") else []
    why = None if row.detail is None else row.detail.why
    if why is None:
        return [printable(", ".join(told))]
    eta = "" if why.eta_s is None else f"; loaded in {duration(why.eta_s)}, as usual"
    return [printable(why.text) + eta, *(printable(f"then {step.text}") for step in why.plan)]


def panel(status: StatusReply, samples: Sequence[Samples], width: int, height: int) -> list[str]:
    """Return all GPUs; of many, those that fit into a third of the terminal."""
    brief = len(status.gpus) > TWO_LINES_MAX or height < TALL
    most = max(2, height // 3)
    lines: list[str] = []
    for at, (gpu, known) in enumerate(zip(status.gpus, samples, strict=True)):
        mine = gpu_lines(gpu, known, width, brief=brief)
        if lines and len(lines) + len(mine) > most:
            return [*lines[: most - 1], f"and {len(status.gpus) - at} more GPUs"]
        lines += mine
    return lines
