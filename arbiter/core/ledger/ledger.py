"""The bytes of one GPU: charges, what processes retain, what stowaways hold.

Ledger and measurement are two gates. Booked bytes are what was granted; evidence (per-process
readings) is only added on top where a process holds more than was booked. Knows nothing of states,
order or time beyond `now`.

One process shares one context among its leases, so an account counts max(its charges together, its
residue): a residue is folded into the next lease of the same process and never charged twice.

Sums are kept as accounts change, never counted again: a decision must not cost more because many
have leases. `disagreement` counts.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

NOTHING: Mapping[LeaseId, int] = {}
NOBODY: Mapping[ProcessKey, int] = {}


@dataclass(slots=True)
class Charge:
    """`approved_bytes` fitted when they were granted; what lies above came later, by the holder's
    own word (pressure)."""

    booked_bytes: int
    approved_bytes: int
    debt: bool = False  # its lease is over, its bytes are not measured gone


@dataclass(slots=True)
class Account:
    """One process on one card."""

    process: ProcessKey
    changed_at: float
    charges: dict[LeaseId, Charge] = field(default_factory=dict)
    residue_bytes: int = 0
    residue_floor_bytes: int = (
        0  # declared; a larger residue was measured and may shrink down to this
    )
    measured_bytes: int = 0  # evidence newer than the last change; 0: none
    charged_bytes: int = 0  # kept sums over the charges
    charged_approved_bytes: int = 0
    counted_bytes: int = 0  # what the ledger's own sums hold of this account
    counted_booked_bytes: int = 0
    counted_approved_bytes: int = 0

    def booked_bytes(self) -> int:
        return max(self.charged_bytes, self.residue_bytes)

    def approved_bytes(self) -> int:
        return max(self.charged_approved_bytes, self.residue_bytes)

    def kept_bytes(self) -> int:
        """What the process keeps beyond its charges: bytes that a new charge would be
        folded with."""
        return max(0, self.residue_bytes - self.charged_bytes)

    def occupied_bytes(self) -> int:
        """Booked, or more where more was measured."""
        return max(self.charged_bytes, self.residue_bytes, self.measured_bytes)


@dataclass(frozen=True, slots=True)
class Stranger:
    """A stowaway: a process that holds bytes and has no account."""

    process: ProcessKey
    name: str
    used_bytes: int


class GpuLedger:
    """All bytes of one card. Every method that changes something takes `now`."""

    def __init__(self, info: GpuInfo, tolerance_bytes: int) -> None:
        self._tolerance_bytes = tolerance_bytes
        self.info = info
        self.budget_bytes = info.capacity_bytes - info.reserve_bytes
        self.accounts: dict[ProcessKey, Account] = {}
        self.strangers: dict[ProcessKey, Stranger] = {}
        self.unnamed_bytes = 0  # used, but in no process's list, beyond the fixed reserve
        self.overhead_bytes: int | None = None  # the driver's own; None: never seen
        self.reserved: set[LeaseId] = set()  # charged for requests that are not granted yet
        self.touched: set[LeaseId] = (
            set()
        )  # charged or dropped since the invariants were checked last
        self._owner: dict[LeaseId, ProcessKey] = {}
        self._occupied_bytes = 0  # kept sums over accounts and strangers
        self._booked_bytes = 0
        self._approved_bytes = 0
        self._strangers_bytes = 0

    # -- reading
    def total_bytes(self) -> int:
        """Booked bytes, evidence above them, and stowaways."""
        return self._occupied_bytes + self._strangers_bytes + self.unnamed_bytes

    def stowaway_bytes(self) -> int:
        return self._strangers_bytes + self.unnamed_bytes

    def booked_bytes(self) -> int:
        """Sum over processes of what was granted or is kept, without any evidence."""
        return self._booked_bytes

    def booked_by(self, process: ProcessKey) -> int:
        """What one process is booked; it may be known by its pid alone, as in a reading."""
        account = self._account_of(process)
        return 0 if account is None else account.booked_bytes()

    def approved_bytes(self) -> int:
        """Sum of what fitted when it was granted."""
        return self._approved_bytes

    def pressure_bytes(self) -> int:
        """By how much everything together exceeds the budget; less than the tolerance is no
        pressure."""
        over = self.total_bytes() - self.budget_bytes
        return over if over > self._tolerance_bytes else 0

    def driver_bytes(self) -> int:
        """What a reading may show that is not charged: the driver's own bytes, or the whole
        reserve while those were never seen."""
        return self.info.reserve_bytes if self.overhead_bytes is None else self.overhead_bytes

    def unlisted_bytes(self, reading: MemorySampled) -> int | None:
        """Return the most that processes outside the list hold together; None: it cannot tell.

        That is the total less what the list shows and what is known to be the driver's.
        """
        if not reading.lists_bytes:
            return None
        listed_bytes = sum(use.held_bytes for use in reading.listed)
        return max(0, reading.used_bytes - listed_bytes - (self.overhead_bytes or 0))

    def charge_bytes(self, lease: LeaseId) -> int:
        owner = self._owner.get(lease)
        return 0 if owner is None else self.accounts[owner].charges[lease].booked_bytes

    def leases(self) -> Iterable[LeaseId]:
        return self._owner.keys()

    def charges(self, lease: LeaseId) -> bool:
        """Is anything charged for this lease, be it nothing but a zero?"""
        return lease in self._owner

    def drift_bytes(self, process: ProcessKey) -> int:
        """How far a process was seen above what is booked for it."""
        account = self.accounts[process]
        return account.occupied_bytes() - account.booked_bytes()

    def total_if(
        self,
        leaving: Mapping[LeaseId, int] = NOTHING,
        joining: Mapping[ProcessKey, int] = NOBODY,
        *,
        stowaways: bool = True,
    ) -> int:
        """Total bytes if some leases left (each keeping the residue given) and processes got so
        many more, beside stowaways or without."""
        total = self.total_bytes() if stowaways else self._occupied_bytes
        if not leaving and not joining:
            return total
        by_process: dict[ProcessKey, dict[LeaseId, int]] = {process: {} for process in joining}
        for lease, residue_bytes in leaving.items():
            owner = self._owner.get(lease)
            if owner is not None:
                by_process.setdefault(owner, {})[lease] = residue_bytes
        for process, going in by_process.items():
            more_bytes = joining.get(process, 0)
            account = self.accounts.get(process)
            if account is None:
                stranger = self._stranger_of(process) if stowaways else None
                total += max(0, more_bytes - (stranger.used_bytes if stranger else 0))
                continue
            total += self._after(account, going, more_bytes) - account.occupied_bytes()
        return total

    def total_if_moved(self, lease: LeaseId, count: int, to: ProcessKey) -> int:
        """Total bytes if so much of a charge were booked on another process: evidence that it
        covered counts from then on."""
        owner = self._owner[lease]
        if owner == to:
            return self.total_bytes()
        account = self.accounts[owner]
        left = max(account.charged_bytes - count, account.residue_bytes, account.measured_bytes)
        return self.total_bytes() + left - account.occupied_bytes() + count

    def process_after_bytes(
        self, process: ProcessKey, going: Mapping[LeaseId, int], *, dead: bool
    ) -> int:
        """What a process may still hold once these leases are gone. A dead one without other debts:
        nothing."""
        account = self.accounts.get(process)
        if account is None:
            return 0
        staying = self._staying(account, going) - self._unfilled_bytes(account)
        if dead:
            return staying
        return max(staying, account.residue_floor_bytes, *going.values())

    def total_after_bytes(
        self, process: ProcessKey, going: Mapping[LeaseId, int], *, dead: bool
    ) -> int:
        """Total bytes once these leases of one process are gone: what a verification expects at
        most."""
        total = self.total_bytes()
        for owner in {self._owner[lease] for lease in self.reserved}:
            total -= self.accounts[owner].occupied_bytes() - self._filled(self.accounts[owner])
        account = self.accounts.get(process)
        if account is None:
            return total
        return total - self._filled(account) + self.process_after_bytes(process, going, dead=dead)

    def _after(self, account: Account, going: Mapping[LeaseId, int], more_bytes: int) -> int:
        if not going:
            return max(
                account.charged_bytes + more_bytes, account.residue_bytes, account.measured_bytes
            )
        staying = self._staying(account, going)
        return max(staying + more_bytes, account.residue_floor_bytes, *going.values())

    def _staying(self, account: Account, going: Mapping[LeaseId, int]) -> int:
        """What is booked for a process's leases but for these."""
        charges = account.charges
        return account.charged_bytes - sum(
            charges[lease].booked_bytes for lease in going if lease in charges
        )

    def filled_bytes(self, process: ProcessKey) -> int:
        """What is booked for a process without what is only kept for leases of it that are not
        granted yet."""
        account = self.accounts.get(process)
        if account is None:
            return 0
        return max(account.charged_bytes - self._unfilled_bytes(account), account.residue_bytes)

    def _filled(self, account: Account) -> int:
        return max(self.filled_bytes(account.process), account.measured_bytes)

    def _unfilled_bytes(self, account: Account) -> int:
        charges = account.charges
        return sum(charges[lease].booked_bytes for lease in self.reserved if lease in charges)

    def disagreement(self) -> str:
        """Where the kept sums and the accounts disagree; "" if nowhere. Counts everything: for
        tests."""
        for process, account in self.accounts.items():
            booked = sum(charge.booked_bytes for charge in account.charges.values())
            approved = sum(charge.approved_bytes for charge in account.charges.values())
            if (booked, approved) != (account.charged_bytes, account.charged_approved_bytes):
                return (
                    f"{process} is charged {booked} ({approved}), kept as {account.charged_bytes} "
                    f"({account.charged_approved_bytes})"
                )
            for lease, charge in account.charges.items():
                if charge.approved_bytes > charge.booked_bytes:
                    return (
                        f"{lease} is booked {charge.booked_bytes} and approved "
                        f"{charge.approved_bytes}"
                    )
        kept = (
            self._occupied_bytes,
            self._booked_bytes,
            self._approved_bytes,
            self._strangers_bytes,
        )
        counted = (
            sum(account.occupied_bytes() for account in self.accounts.values()),
            sum(account.booked_bytes() for account in self.accounts.values()),
            sum(account.approved_bytes() for account in self.accounts.values()),
            sum(stranger.used_bytes for stranger in self.strangers.values()),
        )
        return "" if kept == counted else f"the sums are {counted}, kept as {kept}"

    def _stranger_of(self, process: ProcessKey) -> Stranger | None:
        return self.strangers.get(process) or self.strangers.get(ProcessKey(process.pid, 0))

    # -- changing
    def charge(
        self,
        lease: LeaseId,
        process: ProcessKey,
        booked_bytes: int,
        approved_bytes: int,
        now: float,
    ) -> None:
        """Book a grant (or, after a restart, what a holder reports)."""
        self.reserved.discard(lease)
        account = self._open(process, now)
        self._charge(account, lease, Charge(booked_bytes, approved_bytes))
        self._owner[lease] = process
        self.touched.add(lease)
        self._changed(account, now)

    def reserve(self, lease: LeaseId, process: ProcessKey, count: int, now: float) -> None:
        """Book bytes for a request that is granted later; `charge` makes it a grant, `withdraw`
        ends it.
        """
        self.charge(lease, process, count, count, now)
        self.reserved.add(lease)

    def recharge(self, lease: LeaseId, booked_bytes: int, now: float) -> None:
        """The holder is ready: book what it says it holds. What exceeds the grant was never
        approved."""
        account = self.accounts[self._owner[lease]]
        before = account.charges[lease]
        after = Charge(booked_bytes, min(before.approved_bytes, booked_bytes), before.debt)
        self._charge(account, lease, after)
        self._changed(account, now)

    def rebook(self, lease: LeaseId, booked_bytes: int, approved_bytes: int, now: float) -> None:
        """Change both figures of a charge: a lease has grown."""
        account = self.accounts[self._owner[lease]]
        before = account.charges[lease]
        if (before.booked_bytes, before.approved_bytes) != (booked_bytes, approved_bytes):
            self._charge(account, lease, Charge(booked_bytes, approved_bytes, before.debt))
            self._changed(account, now)

    def charge_of(self, lease: LeaseId) -> Charge:
        """Raises KeyError if nothing is charged for it."""
        return self.accounts[self._owner[lease]].charges[lease]

    def to_debt(self, lease: LeaseId) -> None:
        """The lease is over; its bytes stay charged until measured gone."""
        self.accounts[self._owner[lease]].charges[lease].debt = True

    def drop(self, lease: LeaseId, residue_bytes: int, floor_bytes: int, now: float) -> int:
        """The bytes of a lease came back but for a residue. Returns the residue now charged to its
        process.

        Never more than was charged before: what a process holds beyond that is evidence, not a
        booking.
        """
        account = self.accounts[self._owner.pop(lease)]
        before_bytes = account.approved_bytes()
        self._charge(account, lease, None)
        self.touched.add(lease)
        floor_bytes = max(account.residue_floor_bytes, floor_bytes)
        account.residue_bytes = min(max(residue_bytes, floor_bytes), before_bytes)
        account.residue_floor_bytes = min(floor_bytes, account.residue_bytes)
        self._changed(account, now)
        self._close_if_empty(account)
        return account.residue_bytes

    def withdraw(self, lease: LeaseId, now: float) -> None:
        """Take a charge back that was never filled, or a grant that was never sent: the
        account is as it was before."""
        self.reserved.discard(lease)
        account = self.accounts[self._owner.pop(lease)]
        self._charge(account, lease, None)
        self.touched.add(lease)
        self._changed(account, now)
        self._close_if_empty(account)

    def set_residue(
        self, process: ProcessKey, residue_bytes: int, now: float, floor_bytes: int = 0
    ) -> None:
        """Charge (or, with 0, forget) what a process keeps outside its leases; `floor_bytes` of it
        were declared."""
        account = self._open(process, now)
        account.residue_bytes = residue_bytes
        account.residue_floor_bytes = max(account.residue_floor_bytes, floor_bytes)
        account.residue_floor_bytes = min(account.residue_floor_bytes, residue_bytes)
        self._changed(account, now)
        self._close_if_empty(account)

    def bury(self, process: ProcessKey) -> None:
        """The process died: it is not expected to keep anything. What is charged stays until
        measured gone."""
        self.accounts[process].residue_floor_bytes = 0

    def observe(self, reading: MemorySampled, *, quiet: bool, pending_bytes: int = 0) -> None:
        """Take the evidence of a reading.

        Args:
            quiet: Whether no lease loads or unloads, so that unexplained bytes mean something.
            pending_bytes: How many of the unexplained bytes may be pending free.
        """
        if reading.lists_processes:
            explained_bytes, complete = self._take_list(reading)
        else:
            explained_bytes, complete = self.booked_bytes(), not self.accounts
        if quiet:
            rest_bytes = max(0, reading.used_bytes - explained_bytes)
            self._take_rest(rest_bytes, pending_bytes, complete=complete)

    def _take_list(self, reading: MemorySampled) -> tuple[int, bool]:
        """Take bytes per process. Return the bytes explained, and whether the list explains all."""
        shown: dict[ProcessKey, int] = {}
        self.strangers = {}
        for use in reading.listed:
            account = self._account_of(use.process)
            if account is None:
                self.strangers[use.process] = Stranger(use.process, use.name, use.held_bytes)
            elif use.used_bytes is not None:
                shown[account.process] = use.used_bytes
        self._count_strangers()
        explained_bytes = self._strangers_bytes
        complete = reading.lists_bytes
        for account in self.accounts.values():
            count = shown.get(account.process)
            if reading.taken_at > account.changed_at:
                account.measured_bytes = count or 0
                self._count(account)
            if count is None:
                # The list may omit a process that is dying or in another container: unexplained
                # bytes are its own first, up to its charge, and no stowaway's.
                count = account.booked_bytes()
                complete = complete and not count
            explained_bytes += count
        return explained_bytes, complete

    def _account_of(self, listed: ProcessKey) -> Account | None:
        """Return the account of a process as a reading names it, perhaps by its pid alone."""
        account = self.accounts.get(listed)
        if account is None and not listed.start_ticks:
            named = (one for process, one in self.accounts.items() if process.pid == listed.pid)
            account = next(named, None)
        return account

    def _take_rest(self, rest_bytes: int, pending_bytes: int, *, complete: bool) -> None:
        """Unattributed bytes: the driver's own up to the reserve, a process's beyond it. What may
        be going is neither, if it is new."""
        reserve = self.info.reserve_bytes
        stays_bytes = max(0, rest_bytes - pending_bytes)
        least, most = max(0, stays_bytes - reserve), max(0, rest_bytes - reserve)
        self.unnamed_bytes = min(max(self.unnamed_bytes, least), most)
        if not complete:
            return
        least, most = min(stays_bytes, reserve), min(rest_bytes, reserve)
        if self.overhead_bytes is not None:
            self.overhead_bytes = min(max(self.overhead_bytes, least), most)
        elif least == most:
            self.overhead_bytes = most

    def _open(self, process: ProcessKey, now: float) -> Account:
        account = self.accounts.get(process)
        if account is None:
            account = self.accounts[process] = Account(process, now)
            self.strangers.pop(process, None)
            self.strangers.pop(ProcessKey(process.pid, 0), None)
            self._count_strangers()
        return account

    def _close_if_empty(self, account: Account) -> None:
        if not account.charges and not account.residue_bytes:
            del self.accounts[account.process]

    def _changed(self, account: Account, now: float) -> None:
        account.changed_at = now
        account.measured_bytes = 0  # older evidence no longer says anything about this account
        self._count(account)

    # -- kept sums
    def _charge(self, account: Account, lease: LeaseId, charge: Charge | None) -> None:
        """The one place where an account's charges change. None: the charge goes."""
        before = account.charges.pop(lease, None) if charge is None else account.charges.get(lease)
        if before is not None:
            account.charged_bytes -= before.booked_bytes
            account.charged_approved_bytes -= before.approved_bytes
        if charge is not None:
            account.charges[lease] = charge
            account.charged_bytes += charge.booked_bytes
            account.charged_approved_bytes += charge.approved_bytes

    def _count(self, account: Account) -> None:
        """Bring the ledger's sums up to date with one account."""
        residue = account.residue_bytes
        booked, approved = (
            max(account.charged_bytes, residue),
            max(account.charged_approved_bytes, residue),
        )
        occupied = max(booked, account.measured_bytes)
        self._occupied_bytes += occupied - account.counted_bytes
        self._booked_bytes += booked - account.counted_booked_bytes
        self._approved_bytes += approved - account.counted_approved_bytes
        account.counted_bytes, account.counted_approved_bytes = occupied, approved
        account.counted_booked_bytes = booked

    def _count_strangers(self) -> None:
        self._strangers_bytes = sum(stranger.used_bytes for stranger in self.strangers.values())
