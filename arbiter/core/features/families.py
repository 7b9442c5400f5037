"""The bytes of a lease and its sub-leases: together never more than the root was granted.

A sub-lease is carved out of its parent's charge. Its *share* is what the parent has less because of it, so the sum of a tree
stays what it was whoever carves, becomes ready, leaves or dies. Bytes that come back go to the parent's reservation; a residue
that a sub-lease's process keeps is *borne* by the parent until that process gives it up or gets a lease of its own.
Must not know who is asked to leave, nor why (`subleases`).
"""

from collections.abc import Mapping
from typing import Any

from vram_arbiter.arbiter.core.ledger.ledger import process_bytes
from vram_arbiter.arbiter.core.model.lease import LEAVING, Estate, Lease, Share
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import LeaseId, ProcessKey


# -- what is left --------------------------------------------------------------------------------------------------------
def need_bytes(gpu: Gpu, parent: Lease, process: ProcessKey, peak_bytes: int) -> tuple[int, int]:
    """(bytes that a sub-lease of this process would take from its parent, bytes that are folded with what it holds already)."""
    account = gpu.ledger.accounts.get(process)
    kept = 0 if account is None else account.kept_bytes()
    borne = 0 if parent.estate is None else parent.estate.borne.get(process, 0)
    fold = max(0, kept - borne)
    return max(0, peak_bytes - fold - borne), fold


def left_bytes(gpu: Gpu, parent: Lease) -> int:
    """What the parent can still carve out: its own charge, less what its own process is seen or said to hold.

    One that is ready, and neither says nor shows how much it holds, holds all of it.
    """
    charge = gpu.ledger.charge_of(parent.id)
    own = parent.measured_bytes or 0
    held = None if gpu.sample is None else process_bytes(gpu.sample, parent.process)
    if held is None and parent.said_ready and parent.measured_bytes is None:
        return 0
    if held is not None:
        others = gpu.ledger.accounts[parent.process].charged_bytes - charge.booked_bytes
        own = max(own, held - others)
    return max(0, min(charge.booked_bytes, charge.approved_bytes) - own)


def unfilled_bytes(gpu: Gpu) -> int:
    """What could be carved out on this card: charged, and on it only where somebody holds more than he says."""
    return sum(
        left_bytes(gpu, parent) for parent in gpu.estates.values() if parent.state not in LEAVING
    )


def holds_nothing(core: Core, gpu: Gpu, lease: Lease) -> bool:
    """Was it a reservation and no more: nothing said, nothing seen of its own?"""
    if lease.measured_bytes:
        return False
    held = None if gpu.sample is None else process_bytes(gpu.sample, lease.process)
    if held is None:
        return not lease.said_ready
    account = gpu.ledger.accounts[lease.process]
    others = account.charged_bytes - gpu.ledger.charge_bytes(lease.id)
    kept = max(others, account.residue_bytes, lease.spec.residue_bytes)
    return held <= kept + core.settings.verify_tolerance_bytes


# -- changing ------------------------------------------------------------------------------------------------------------
def join(core: Core, gpu: Gpu, parent: Lease, child: Lease, fold_bytes: int) -> None:
    """A charged lease becomes a sub-lease: its parent has so much less."""
    if parent.estate is None:
        charge = gpu.ledger.charge_of(parent.id)
        parent.estate = Estate(charge.booked_bytes, charge.approved_bytes)
        gpu.estates[parent.id] = parent
    parent.estate.borne.pop(child.process, None)
    parent.estate.shares[child.id] = Share(0, 0, fold_bytes)
    parent.children.append(child)
    child.parent = parent
    _share(core, gpu, child)


def recharge(core: Core, gpu: Gpu, lease: Lease, booked_bytes: int) -> None:
    """The holder is ready. What it does not need goes back to its parent; what exceeds its grant was never approved.

    One that lends keeps its steady bytes, or what it and its sub-leases hold if that is more.
    """
    if lease.estate is None:
        gpu.ledger.recharge(lease.id, booked_bytes, core.now)
    else:
        estate = lease.estate
        lent = sum(share.approved_bytes for share in estate.shares.values()) + sum(
            estate.borne.values()
        )
        estate.booked_bytes = max(lease.steady_bytes, lent + (lease.measured_bytes or 0))
        estate.approved_bytes = min(estate.approved_bytes, estate.booked_bytes)
        _rebook(core, gpu, lease)
    if lease.parent is not None:
        _share(core, gpu, lease)


def gone(core: Core, gpu: Gpu, lease_id: LeaseId, process: ProcessKey) -> None:
    """The bytes of a lease are no longer charged. If it was carved out of another, they are that one's again, but for a residue.

    Of a parent that is on its way out itself they are simply free.
    """
    for parent in gpu.estates.values():
        estate = _estate(parent)
        share = estate.shares.pop(lease_id, None)
        if share is None:
            continue
        if parent.state in LEAVING:
            _shrink(estate, share.booked_bytes, share.approved_bytes)
        else:
            account = gpu.ledger.accounts.get(process)
            kept = 0 if account is None else account.kept_bytes()
            if kept > share.fold_bytes:
                estate.borne[process] = kept - share.fold_bytes
        _rebook(core, gpu, parent)
        core.record_lease(parent)
        core.wake(gpu)
        return


def residue_fell(core: Core, gpu: Gpu, process: ProcessKey) -> None:
    """A process keeps less than before: whoever bore it has the difference again."""
    account = gpu.ledger.accounts.get(process)
    kept = 0 if account is None else account.kept_bytes()
    for parent in gpu.estates.values():
        borne = _estate(parent).borne
        if borne.get(process, 0) > kept:
            del borne[process]
            if kept:
                borne[process] = kept
            _rebook(core, gpu, parent)
            core.record_lease(parent)


def claim(core: Core, gpu: Gpu, process: ProcessKey) -> None:
    """A process gets a lease of its own: what it kept is folded with that, nobody else's to have back."""
    for parent in gpu.estates.values():
        estate = _estate(parent)
        borne = estate.borne.pop(process, 0)
        if borne:
            _shrink(estate, borne, borne)
            core.record_lease(parent)


def close(gpu: Gpu, lease: Lease) -> None:
    """A lease with sub-leases is over. They are its heirs: each a root of its own that keeps its charge."""
    if gpu.estates.pop(lease.id, None) is None:
        return
    lease.estate = None
    for child in lease.children:
        child.parent = None
    lease.children.clear()


# -- after a restart -----------------------------------------------------------------------------------------------------
def restore(gpu: Gpu, lease: Lease, record: Mapping[str, Any]) -> None:
    """What the journal says of a lease's sub-leases. They are tied to it by `tie`, once all are there."""
    shares = {LeaseId(key): Share(*share) for key, share in record["shares"].items()}
    borne = {ProcessKey(pid, ticks): count for pid, ticks, count in record["borne"]}
    lease.estate = Estate(int(record["booked_bytes"]), int(record["approved_bytes"]), shares, borne)
    gpu.estates[lease.id] = lease


def tie(core: Core, gpu: Gpu, parents: Mapping[LeaseId, str]) -> None:
    """Tie restored sub-leases to their parents. A share of which nothing is charged any more is gone for good."""
    for lease_id, parent_id in parents.items():
        child, parent = core.leases.get(lease_id), gpu.estates.get(LeaseId(parent_id))
        if child is not None and parent is not None:
            child.parent = parent
            parent.children.append(child)
    for parent in gpu.estates.values():
        estate = _estate(parent)
        for lease_id in [
            lease_id for lease_id in estate.shares if not gpu.ledger.charges(lease_id)
        ]:
            share = estate.shares.pop(lease_id)
            _shrink(estate, share.booked_bytes, share.approved_bytes)


def unshared(gpu: Gpu) -> str:
    """Where a tree's bytes do not add up; "" if nowhere. For the invariants."""
    for parent in gpu.estates.values():
        booked, approved = _left(_estate(parent))
        charge = gpu.ledger.charge_of(parent.id)
        if charge.booked_bytes != booked or charge.approved_bytes > approved:
            return f"{parent.id} is charged {charge.booked_bytes} ({charge.approved_bytes}), {booked} ({approved}) are left of it"
        for child in parent.children:
            if child.parent is not parent or child.id not in _estate(parent).shares:
                return f"{child.id} is no sub-lease of {parent.id}, though it says so"
    return ""


# -- steps ---------------------------------------------------------------------------------------------------------------
def _estate(parent: Lease) -> Estate:
    assert parent.estate is not None, f"{parent.id} is listed without an estate"
    return parent.estate


def _shrink(estate: Estate, booked_bytes: int, approved_bytes: int) -> None:
    estate.booked_bytes -= booked_bytes
    estate.approved_bytes -= approved_bytes


def _left(estate: Estate) -> tuple[int, int]:
    borne = sum(estate.borne.values())
    booked = (
        estate.booked_bytes - borne - sum(share.booked_bytes for share in estate.shares.values())
    )
    approved = (
        estate.approved_bytes
        - borne
        - sum(share.approved_bytes for share in estate.shares.values())
    )
    return max(0, booked), max(0, approved)


def _rebook(core: Core, gpu: Gpu, parent: Lease) -> None:
    """What is left of it. A sub-lease that took more than its share has it from here: that much is no longer approved either."""
    booked, approved = _left(_estate(parent))
    gpu.ledger.rebook(parent.id, booked, min(approved, booked), core.now)


def _share(core: Core, gpu: Gpu, child: Lease) -> None:
    """A sub-lease is charged otherwise than before: its parent has the rest."""
    parent = child.parent
    assert parent is not None, f"{child.id} is no sub-lease"
    share = _estate(parent).shares[child.id]
    charge = gpu.ledger.charge_of(child.id)
    booked, approved = charge.booked_bytes, charge.approved_bytes
    if child.estate is not None:
        booked, approved = child.estate.booked_bytes, child.estate.approved_bytes
    share.booked_bytes = max(0, booked - share.fold_bytes)
    share.approved_bytes = max(0, approved - share.fold_bytes)
    _rebook(core, gpu, parent)
