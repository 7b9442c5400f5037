"""Every invariant over everything, and the tables that the check of each event relies on.

The engine checks what an event changed (`core.invariants`). Drivers of tests and the simulation
also check everything, in O(leases).
"""

from collections import Counter

from tests.support.engine_state import state_of
from tests.support.typed import missing
from vram_arbiter.arbiter.core import invariants
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.ledger import GpuLedger
from vram_arbiter.arbiter.core.model.gpu import Residents
from vram_arbiter.arbiter.core.model.lease import AWAY, LeaseState
from vram_arbiter.arbiter.core.model.state import Client, Core, Turn
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas.ids import ClientId, ProcessKey


def check_arbiter(arbiter: Arbiter) -> None:
    """Raise InvariantViolation if any record is unsound; number 0: a table is."""
    check_all(state_of(arbiter))


def check_all(core: Core) -> None:
    """Raise InvariantViolation if any record is unsound; number 0: a table is."""
    if problem := values_missing(core) or owners_disagree(core):
        raise InvariantViolation(0, problem)
    for gpu in core.gpus.values():
        if problem := ledger_disagrees(gpu.ledger) or residents_disagree(gpu.residents):
            raise InvariantViolation(0, f"{gpu.info.id}: {problem}")
        gpu.ledger.touched.update(gpu.ledger.charges, gpu.residents)
        for lease in gpu.residents.values():
            in_use = lease.state in (LeaseState.HELD, LeaseState.REVOKING)
            if not in_use and (uses := len(lease.uses)):
                raise InvariantViolation(3, f"{lease.id} is {lease.state} with {uses} uses")
    turn, core.turn = core.turn, Turn(granted=core.turn.granted)
    for gpu in core.gpus.values():
        gpu.touched = True
    invariants.check(core)
    for gpu in core.gpus.values():
        gpu.touched = False
    core.turn = turn
    unqueued = core.waiting.keys() - {lease.id for gpu in core.gpus.values() for lease in gpu.queue}
    if unqueued:
        raise InvariantViolation(0, f"{sorted(unqueued)} wait in no queue")
    away = [lease.id for lease in core.leases.values() if lease.state in AWAY]
    if sorted(core.away) != sorted(away):
        raise InvariantViolation(0, f"{sorted(away)} are away, kept as {sorted(core.away)}")


def forgotten_waiter(core: Core) -> str:
    """Return the head of a queue that fits and is not granted, with its GPU; "" if there is none.

    Right whenever the engine rests, and no reading that it asked for is under way.
    """
    oldest = core.now - core.settings.sample_max_age_s
    for gpu in core.gpus.values():
        head = gpu.queue.head
        if head is None or core.blocked(gpu) or gpu.asked_at is not None:
            continue
        room_bytes = admission.measured_room_bytes(gpu, oldest)
        needed_bytes = admission.measured_need_bytes(gpu, head)
        if admission.fits(gpu, head) and room_bytes is not None and room_bytes >= needed_bytes:
            return f"{head.id} on {gpu.info.id}"
    return ""


def values_missing(core: Core) -> str:
    """Return what is None and may not be, "" if nothing is."""
    records: list[object] = [*core.gpus.values(), *core.clients.values()]
    plain: list[object] = [core]
    for gpu in core.gpus.values():
        plain.append(gpu.ledger)
        records += [*gpu.verifications.values(), *gpu.evictions, *gpu.ledger.accounts.values()]
    for lease in core.leases.values():
        records += [lease, lease.request, lease.departure, lease.standby, lease.observed]
        records += lease.uses.values()
        if None in lease.story[-1]:
            return f"{lease.id}: {lease.story[-1]}"
    if odd := next(filter(None, map(missing, records)), ""):
        return odd
    told = [(name, value) for one in plain for name, value in vars(one).items()]
    return next((name for name, value in told if value is None and name != "drain"), "")


def owners_disagree(core: Core) -> str:
    """Return where the tables of owners and the leases disagree, "" if nowhere."""
    by_process = {lease_id: owner for owner, some in core._of_process.items() for lease_id in some}
    by_client = {lease_id: owner for owner, some in core.of_client.items() for lease_id in some}
    for lease in core.leases.values():
        listed = (by_process.pop(lease.id, None), by_client.pop(lease.id, None))
        if listed != (lease.process, lease.client):
            return f"{lease.id} is not listed under its process and its client"
    if by_process or by_client:
        return f"{sorted({**by_process, **by_client})} are listed and gone"
    marked = {(*use, lease.id) for lease in core.leases.values() for use in lease.uses}
    listed_uses = {(who, use, lease) for who, mine in core.users.items() for lease, use in mine}
    if odd := marked ^ listed_uses:
        return f"{sorted(odd)}: uses are listed otherwise than they are"
    owners = Counter(
        owner for lease in core.waiting.values() for owner in (lease.process, lease.request.uid)
    )
    if owners != core.waiting.of:
        return f"waiters are {owners}, kept as {core.waiting.of}"
    connected: dict[ProcessKey, dict[ClientId, Client]] = {}
    for client in core.clients.values():
        connected.setdefault(client.process, {})[client.id] = client
    if connected != core.connected:
        return f"{connected} are connected, kept as {core.connected}"
    return ""


def ledger_disagrees(ledger: GpuLedger) -> str:
    """Return where the kept sums and the accounts disagree, "" if nowhere."""
    charges, sums = {}, [0, 0, 0]
    for process, account in ledger.accounts.items():
        charges.update(account.charges)
        owed = account.charges.values()
        booked = sum(charge.charged_bytes for charge in owed)
        approved = sum(charge.approved_bytes for charge in owed)
        kept = (account.leased_bytes, account.leased_approved_bytes)
        if (booked, approved) != kept:
            return f"{process} is charged {(booked, approved)}, kept as {kept}"
        for lease, charge in account.charges.items():
            if charge.approved_bytes > charge.charged_bytes:
                return (
                    f"{lease} is booked {charge.charged_bytes} and approved {charge.approved_bytes}"
                )
        retained, measured = account.retained_bytes, account.measured_bytes
        sums[0] += max(booked, retained)
        sums[1] += max(approved, retained)
        sums[2] += max(booked, retained, measured)
    kept_sums = [ledger.charged_bytes, ledger.approved_bytes, ledger._held_bytes]
    if kept_sums != sums:
        return f"the sums are {sums}, kept as {kept_sums}"
    if ledger.charges != charges:
        return f"the charges are {charges}, kept as {ledger.charges}"
    stowaways = sum(use.held_bytes for use in ledger.stowaways.values()) + ledger.unattributed_bytes
    kept_bytes = ledger.stowaway_bytes
    return "" if kept_bytes == stowaways else f"stowaways have {stowaways}, kept as {kept_bytes}"


def residents_disagree(residents: Residents) -> str:
    """Return where the tables and the leases of a GPU disagree, "" if nowhere."""
    listed = {(lease, state) for state, table in residents.by_state.items() for lease in table}
    if odd := listed ^ {(lease.id, lease.state) for lease in residents.values()}:
        return f"{sorted(odd)}: states are listed otherwise than they are"
    exclusive = {lease.id for lease in residents.values() if lease.spec.exclusive}
    if residents.exclusive != exclusive:
        return f"{sorted(residents.exclusive)} are listed as exclusive"
    return ""
