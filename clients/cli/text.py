"""How `vramctl` says things: replies of the arbiter as lines of text. Pure; sizes in GiB/MiB, times
in seconds.

It stands on the fast path: no pydantic, no rich here. Whatever a reply quotes is escaped
(`schemas.runtime.printable`).
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import makes_printable, printable
from vram_arbiter.schemas.sizes import format_bytes

_COLUMNS = (
    "LEASE",
    "CONSUMER",
    "MODEL",
    "GPU",
    "STATE",
    "CHARGE",
    "DRIFT",
    "USES",
    "PRIO",
    "PID",
    "SINCE",
)
_RIGHT = frozenset({"CHARGE", "DRIFT", "USES", "PRIO", "PID", "SINCE", "IN FLIGHT", "WAITING"})
_NOT_SHOWN = frozenset(
    (
        *("seq", "at_wall_s", "kind", "lease_id", "consumer", "reason", "gpu", "token"),
        *("traceparent", "trace_id", "span_id", "parent_id", "trace_flags"),
    )
)


def duration(seconds: float) -> str:
    """`0.4 s`, `12 s`, `3 min`, `5 h`, `2 d`."""
    for limit, factor, unit in (
        (10.0, 1.0, ""),
        (120.0, 1.0, "s"),
        (7200.0, 60.0, "min"),
        (172_800.0, 3600.0, "h"),
    ):
        if seconds < limit:
            return f"{seconds:.1f} s" if not unit else f"{seconds / factor:.0f} {unit}"
    return f"{seconds / 86_400:.0f} d"


def plural(count: int, word: str) -> str:
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


# -- status
@makes_printable
def status_lines(status: JsonMap) -> list[str]:
    """Return the arbiter, each GPU with its other processes, and all leases: residents, then the
    queue."""
    lines = [
        f"arbiter {status['phase']} · epoch {status['epoch']} · up {duration(status['uptime_s'])} "
        "· " + plural(status["clients"], "client")
    ]
    if status["phase"] == "recovering":
        lines.append("  restarted: nothing is granted until every lease is accounted for")
    if status.get("drained"):
        lines.append(f"  drained by {status['drained']}; nothing is granted until `vramctl resume`")
    lines += [f"  {problem}" for problem in status.get("problems", ())]
    for gpu in status["gpus"]:
        lines += ["", *_gpu_lines(gpu)]
    demands = demand_lines(status.get("demands", ()))
    demands = ["", *demands] if demands else []
    lines.append("")
    if not status["leases"]:
        return [*lines, "no leases", *demands]
    indices = {gpu["gpu"]: str(gpu["index"]) for gpu in status["gpus"]}
    rows = [_lease_row(lease, indices) for lease in status["leases"]]
    drift = _COLUMNS.index("DRIFT")
    hidden = {
        _COLUMNS.index("GPU"): len(indices) < 2,  # where there is one, it is said above
        drift: not any(row[drift] for row in rows),
    }
    shown = [at for at in range(len(_COLUMNS)) if not hidden.get(at)]
    leases = table([_COLUMNS[at] for at in shown], [[row[at] for at in shown] for row in rows])
    return [*lines, *leases, *demands]


def demand_lines(demands: Sequence[JsonMap]) -> list[str]:
    """Return a table of requests at consumers; empty: no client told of any."""
    columns = ("REQUESTS OF", "IN FLIGHT", "WAITING", "TOLD BY")
    rows = [
        (one["consumer"], str(one["in_flight"]), str(one["waiting"]), one["client"])
        for one in demands
    ]
    return table(columns, rows) if rows else []


def _gpu_lines(gpu: JsonMap) -> list[str]:
    size, known = format_bytes, gpu["measured_used_bytes"] is not None
    room = (
        gpu["capacity_bytes"] - gpu["reserve_bytes"] - gpu["charged_bytes"] - gpu["stowaway_bytes"]
    )
    lines = [
        f"GPU {gpu['index']} {gpu['name']} ({gpu['gpu']})",
        f"  capacity {size(gpu['capacity_bytes'])}{' =' if known else ':'} reserve "
        f"{size(gpu['reserve_bytes'])} + charged {size(gpu['charged_bytes'])}"
        + (f" + stowaways {size(gpu['stowaway_bytes'])}" if gpu["stowaway_bytes"] else "")
        + (f" + free {size(max(0, room))}" if known else ""),
    ]
    if not known:
        lines.append("  measured: unknown (the probe fails), so nothing is granted")
    else:
        lines.append(
            f"  measured {size(gpu['measured_used_bytes'])} in use, "
            f"{duration(gpu['sample_age_s'] or 0.0)} ago"
        )
    if sensors := sensors_text(gpu.get("sensors", {})):
        lines.append(f"  {sensors}")
    if gpu["pressure_bytes"]:
        lines.append(f"  pressure: {size(gpu['pressure_bytes'])} more than was granted")
    if gpu["blocked"] is not None:
        lines.append(f"  no grants now: {gpu['blocked']['text']}")
    for process in gpu["processes"]:
        used = "?" if process.get("used_bytes") is None else size(process["used_bytes"])
        who = f"pid {process['pid']} {process.get('name') or ''}".rstrip()
        if process["stowaway"]:
            lines.append(f"  stowaway {who}: {used} without a lease")
        elif process.get("residue_bytes"):
            lines.append(f"  residue of {who}: {size(process['residue_bytes'])}")
    return lines


def sensors_text(sensors: JsonMap) -> str:
    """Return `87 % busy, 64 °C, 215 W`, without what is unknown."""
    told = (
        f"{figure * factor:.0f} {unit}"
        for key, factor, unit in _SENSORS
        if (figure := sensors.get(key)) is not None
    )
    return ", ".join(told)


_SENSORS = (("utilization", 100, "% busy"), ("temperature_c", 1, "°C"), ("power_w", 1, "W"))


def _lease_row(lease: JsonMap, indices: Mapping[str, str]) -> tuple[str, ...]:
    state = lease["state"]
    if "position" in lease:
        state = f"{state} #{lease['position']}"
    elif state == "held":
        state = "held, in use" if lease["uses"] else "held, idle"
    if not lease["evictable"]:
        state += ", pinned"
    return (
        lease["lease_id"],
        lease["consumer"],
        lease["model"],
        indices.get(lease["gpu"] or "", ""),
        state,
        format_bytes(lease["charge_bytes"]),
        _drift(lease.get("drift_bytes") or 0),
        str(lease["uses"]),
        str(lease["priority"]),
        str(lease["pid"]),
        duration(_since_s(lease)),
    )


def _since_s(lease: JsonMap) -> float:
    """Since the grant of a lease with bytes on a GPU; otherwise since it waits, or since
    it left."""
    if lease["state"] in ("queued", "standby", "parked"):
        return float(lease["since_s"])
    return float(lease.get("granted_s", lease["since_s"]))


def _drift(count: int) -> str:
    """How far a lease is above or below what it declared; nothing where that is no news."""
    return "" if not count else f"{'+' if count > 0 else '-'}{format_bytes(abs(count))}"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns as wide as their longest cell, numbers to the right."""
    shown = [[printable(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in [columns, *shown]) for i in range(len(columns))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.rjust(width) if column in _RIGHT else cell.ljust(width)
            for cell, width, column in zip(cells, widths, columns, strict=True)
        )
        return "  ".join(padded).rstrip()

    return [line(columns), *(line(row) for row in shown)]


# -- why
@makes_printable
def why_lines(why: JsonMap) -> list[str]:
    """Return what blocks a consumer: leases, bytes, conditions, what happens next and when."""
    if not why["leases"]:
        name = why["consumer"]
        return [
            f"{name} has no lease and waits for none (all leases: `vramctl status`; what became of "
            f"it: `vramctl history -c {name}`)"
        ]
    lines: list[str] = []
    for lease in why["leases"]:
        lines += [lease["text"], *_why_details(lease)]
    return lines


def _why_details(lease: JsonMap) -> list[str]:
    size = format_bytes
    lines = [
        f"  lease     {lease['lease_id']}, {lease['state']}",
        *_footprint_lines(lease.get("footprint")),
    ]
    if lease["state"] != "queued":
        return lines
    lines.append(
        f"  bytes     needs {size(lease['needed_bytes'])}, free {size(lease['free_bytes'])}, "
        f"missing {size(lease['deficit_bytes'])}"
    )
    for blocker in lease["blockers"]:
        lines.append(
            f"  blocked   by {blocker['consumer']} ({blocker['lease_id']}): "
            f"{size(blocker['bytes'])}, "
            f"{blocker['state']}, {blocker['text']}"
        )
    lines.append(f"  next      {lease['next']}")
    lines += [f"  then      {step['text']}" for step in lease.get("plan", ())]
    eta = lease["eta_s"]
    expected = "unknown"
    if eta is not None:
        expected = f"in {duration(eta)} ({lease['eta_source']})"
    return [*lines, f"  expected  {expected}"]


# -- by hand
@makes_printable
def by_hand_lines(action: str, reply: JsonMap) -> list[str]:
    """What an operator's action did, and what happens next."""
    if "drained" in reply:
        return [
            f"drained by {reply['drained']}; holders keep their leases"
            if reply["drained"]
            else "grants resumed"
        ]
    lease = reply.get("lease")
    if lease is None:
        return [f"given up: its bytes stay charged until they are measured gone ({reply['state']})"]
    name = f"{lease['consumer']} ({lease['lease_id']})"
    if action == "pin":
        return [f"{name} is pinned: it is not evicted until `vramctl unpin {lease['lease_id']}`"]
    if action == "unpin":
        return [f"{name} is no longer pinned by an operator"]
    if action == "kill":
        return [
            f"the process of {name}, pid {lease['pid']}, was told to end",
            "if it stays: ask for --kill once more, which sends SIGKILL",
        ]
    uses = lease["uses"]
    wait = f"finishes {plural(uses, 'use')}, then unloads" if uses else "unloads now"
    return [f"{name} was revoked: it {wait}; follow it with `vramctl why {lease['consumer']}`"]


def _footprint_lines(footprint: JsonMap | None) -> list[str]:
    """Declared and measured bytes per part; nothing before anything was measured."""
    if footprint is None or not any(footprint["learnt_bytes"].values()):
        return []
    parts = [
        f"{part.replace('_', ' ')} {format_bytes(declared)} (measured {format_bytes(measured)})"
        if (measured := footprint["learnt_bytes"][part])
        else f"{part.replace('_', ' ')} {format_bytes(declared)}"
        for part, declared in footprint["declared_bytes"].items()
    ]
    return [f"  footprint {', '.join(parts)}"]


# -- events
QUIET_KINDS = frozenset({"use_began", "use_ended", "revoke_acked", "reminded", "unloading"})
"""Steps that other events sum up; `clients/observer/page/static/story.js` has the same list."""


def is_quiet(event: JsonMap) -> bool:
    """Return whether people see this event only on request: a step, a load that evicted no lease,
    or the verdict on a process that had no lease."""
    if event["kind"] == "switch":
        return not event.get("switched")
    if event["kind"] == "verified":
        return not event.get("lease_id")
    return event["kind"] in QUIET_KINDS


def event_line(event: JsonMap) -> str:
    """One history event: local date and time, kind, consumer and lease, reason, and its other plain
    fields."""
    at = event["at_wall_s"]
    clock = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at)) + f".{int(at * 1000) % 1000:03d}"
    who = " ".join(str(event[key]) for key in ("consumer", "lease_id") if event.get(key))
    more = [
        _field(key, value)
        for key, value in event.items()
        if key not in _NOT_SHOWN and _plain(value)
    ]
    parts = [clock, f"{event['kind']:<14}", who, str(event.get("reason") or ""), " ".join(more)]
    return printable("  ".join(part for part in parts if part))


def _plain(value: object) -> bool:
    return value is not None and not isinstance(value, dict | list | tuple)


def _field(key: str, value: Any) -> str:
    """`charge=1GiB`, `waited=12.3ms`, `eta=3.5s`, `uses=2`: the unit stands behind the number, not
    in the name."""
    key = "quiesce_ms" if key == "drain_ms" else key  # the wire's name of the phase
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if key.endswith("_bytes") and isinstance(value, int):
        return f"{key.removesuffix('_bytes')}={format_bytes(value).replace(' ', '')}"
    if number and (key == "ms" or key.endswith("_ms")):
        return f"{key.removesuffix('ms').removesuffix('_') or 'took'}={_seconds(value / 1e3)}"
    if number and key.endswith("_s"):
        return f"{key.removesuffix('_s')}={_seconds(value)}"
    if isinstance(value, float):
        return f"{key}={f'{value:.3f}'.rstrip('0').rstrip('.')}"
    return f"{key}={value}"


def _seconds(seconds: float) -> str:
    """`0.4ms`, `950.0ms`, `3.5s`, `3512.0s`."""
    return f"{seconds * 1e3:.1f}ms" if abs(seconds) < 1 else f"{seconds:.1f}s"


def error_line(error: JsonMap) -> str:
    """`message (hint)` of a typed error."""
    hint = f" ({error['hint']})" if error.get("hint") else ""
    return printable(f"vramctl: {error['message']}{hint}")
