"""Checks of what the arbiter says: its files, grants, GPUs, processes without a lease; and of what
the kernel may do to the daemon when memory runs out."""

from collections.abc import Iterator
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import (
    CouldNotLook,
    Finding,
    error,
    note,
    ok,
    warning,
)
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.replies import StatusReply

UNIT_SCORE: Final = -500
"""OOMScoreAdjust= of the unit."""


def status_of(m: Machine) -> StatusReply:
    """Return what the arbiter said. Raises CouldNotLook."""
    if m.arbiter.status is None:
        raise CouldNotLook("no arbiter answers")
    return m.arbiter.status


def daemon(m: Machine) -> Iterator[Finding]:
    """The daemon serves, grants, and can write its files."""
    if (refusal := m.arbiter.refusal) is not None:
        yield error("daemon.refuses", refusal.message, refusal.hint or "vramctl status")
        return
    status = status_of(m)
    yield ok("daemon.serves", f"{status.phase}, epoch {status.epoch}, {status.clients} clients")
    for problem in status.problems:
        full = "cannot be written" in problem or "does not answer" in problem
        yield error("daemon.files", problem, "df -h /var/lib" if full else "vramctl status")
    if status.drained:
        yield error("daemon.drained", f"drained by {status.drained}", "vramctl resume")


def probe(m: Machine) -> Iterator[Finding]:
    """Each GPU can be read, and holds no more than was granted."""
    gpus = status_of(m).gpus
    if not gpus:
        yield error("probe.none", "the arbiter leases no GPU", "nvidia-smi")
    for gpu in gpus:
        name, blocked = f"gpu {gpu.index} {gpu.name}", gpu.blocked
        if gpu.measured_used_bytes is None:
            why = "" if blocked is None else f" ({blocked.text})"
            what = f"{name}: its probe does not answer, nothing is granted{why}"
            yield error("probe.unreadable", what, "nvidia-smi")
        elif gpu.pressure_bytes:
            what = f"{name}: {format_bytes(gpu.pressure_bytes)} more are held than were granted"
            kinds = "--kind pressure --kind stowaway --kind drift"
            yield error("probe.pressure", what, f"vramctl history {kinds}")
        elif blocked is not None:
            what = f"{name}: no grants now: {blocked.text}"
            yield note("probe.blocked", what, "vramctl status")
        else:
            yield ok("probe.reads", f"{name}: its probe answers (source {gpu.source})")


def stowaways(m: Machine) -> Iterator[Finding]:
    """Every process with bytes on a GPU has a lease."""
    for one in (one for gpu in status_of(m).gpus for one in gpu.processes if one.stowaway):
        size = "unknown bytes" if one.used_bytes is None else format_bytes(one.used_bytes)
        vram = size.replace(" ", "") if one.used_bytes else "SIZE"
        again = " ".join(word for word in m.command_line(one.pid) if word) or one.name
        yield warning(
            "stowaways.process",
            f"pid {one.pid} {one.name} holds {size} without a lease",
            f"kill {one.pid}; vramctl run --vram {vram} -- {again}",
        )


def out_of_memory(m: Machine) -> Iterator[Finding]:
    """The daemon is not the first to be killed."""
    score = int(m.daemon_file("oom_score_adj"))
    if score > 0 or (score > UNIT_SCORE and m.is_system):
        yield warning(
            "oom.score",
            f"oom_score_adj of the daemon is {score}: when host memory runs out it ends before "
            "programs that it knows",
            f"echo {UNIT_SCORE} | {m.sudo}tee /proc/{m.arbiter.pid}/oom_score_adj",
        )
