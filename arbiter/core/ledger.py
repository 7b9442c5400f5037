"""The bytes of one GPU: charges, bytes that live processes retain, stowaways; what a reading tells
beside its total (`bytes_of`, `bytes_by_process`); and host RAM for parked weights (`HostRam`).

Ledger and measurement are two gates. A charge is what was granted; evidence (readings per process)
is only added on top where a process holds more than it is charged. Knows nothing of states, order
or time beyond `now`.

One process shares one context among its leases, so an account holds the larger of its charges
together and its retained bytes: these are folded into the next lease of the same process and never
charged twice.

Sums are kept as accounts change, never counted again: a decision must not cost more because many
have leases.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.notes import OverHolder, PressureNote

NOTHING: Mapping[LeaseId, int] = {}


@dataclass(slots=True, eq=False)
class Account:
    """One process on one GPU. `GpuLedger` alone writes it, and keeps the sums up to date."""

    process: ProcessKey
    changed_at: float = 0.0
    charges: dict[LeaseId, "Charge"] = field(default_factory=dict)
    retained_bytes: int = 0  # outside its leases
    retained_floor_bytes: int = 0  # declared; more was measured and may shrink down to this
    measured_bytes: int = 0  # evidence newer than the last change; 0: none
    shown_in: MemorySampled | None = None  # newest reading that listed bytes of the process
    # sums over the charges: all, what fitted when it was granted
    leased_bytes: int = 0
    leased_approved_bytes: int = 0
    # the larger of charged and retained bytes: all, what fitted
    charged_bytes: int = 0
    approved_bytes: int = 0
    held_bytes: int = 0  # charged, or more where more was measured


@dataclass(slots=True)
class Charge:
    """Bytes of one lease; a change makes another. `approved_bytes` fitted when they were granted;
    what lies above came later, by the holder's own word (pressure)."""

    account: Account = field(repr=False)
    charged_bytes: int
    approved_bytes: int


class GpuLedger:
    """All bytes of one GPU. Every method that changes something takes `now`."""

    def __init__(self, info: GpuInfo, tolerance_bytes: int) -> None:
        self.tolerance_bytes = tolerance_bytes
        self.info = info
        self.budget_bytes = info.capacity_bytes - info.reserve_bytes
        self.accounts: dict[ProcessKey, Account] = {}
        self.charges: dict[LeaseId, Charge] = {}
        self.touched: set[LeaseId] = set()  # charged or dropped since the last check of invariants
        self.stowaways: dict[ProcessKey, ProcessUse] = {}  # listed processes without an account
        self.unattributed_bytes = 0  # used, but in no process's list, beyond the fixed reserve
        # what a reading may show that is not charged: the whole reserve until the driver's own
        # bytes were seen
        self.driver_bytes = info.reserve_bytes
        self.driver_seen = False
        self.pressed = False  # a note of pressure is out
        # kept sums: over the stowaways and what is unattributed, and over the accounts
        self.stowaway_bytes = 0
        self.charged_bytes = 0
        self.approved_bytes = 0
        self._held_bytes = 0

    # -- reading
    def total_bytes(self) -> int:
        """Return charged bytes, evidence above them, and stowaways."""
        return self._held_bytes + self.stowaway_bytes

    def pressure_bytes(self) -> int:
        """Return by how much everything together exceeds the budget; less than the tolerance is no
        pressure."""
        over = self._held_bytes + self.stowaway_bytes - self.budget_bytes
        return over if over > self.tolerance_bytes else 0

    def note_pressure(self) -> PressureNote | None:
        """Bring `pressed` up to date. Return the note of its begin or end; None: as before."""
        pressure_bytes = self.pressure_bytes()
        if bool(pressure_bytes) == self.pressed:
            return None
        self.pressed = bool(pressure_bytes)
        over = [(a.process, a.held_bytes - a.charged_bytes) for a in self.accounts.values()]
        holders = tuple(OverHolder(p.pid, n) for p, n in over if n > self.tolerance_bytes)
        return PressureNote(self.info.id, pressure_bytes, self.stowaway_bytes, holders)

    def impossible(self, reading: MemorySampled) -> str:
        """Say why a reading cannot be true; "" if it can. Nonsense means unknown, never free."""
        used, total, info = reading.used_bytes, reading.total_bytes, self.info
        if info.total_bytes and abs(total - info.total_bytes) > self.tolerance_bytes:
            return (
                f"impossible reading: {total} bytes of memory, {info.total_bytes} at the start; "
                "if that is so now, restart the arbiter"
            )
        if total < info.capacity_bytes - self.tolerance_bytes:
            told = f"{total} bytes of memory, {info.capacity_bytes} are leased out"
            return f"impossible reading: {told}"
        if not 0 <= used <= total + self.tolerance_bytes:
            return f"impossible reading: {used} of {total} bytes are used"
        for use in reading.processes or ():
            if not 0 <= use.held_bytes <= total + self.tolerance_bytes:
                told = f"process {use.process.pid} holds {use.held_bytes} of {total} bytes"
                return f"impossible reading: {told}"
        return ""

    def unlisted_bytes(self, reading: MemorySampled) -> int | None:
        """Return the most that processes outside the list hold together; None: it cannot tell.

        That is the total less what the list shows and what is known to be the driver's.
        """
        if reading.processes is None or any(use.used_bytes is None for use in reading.processes):
            return None
        listed_bytes = sum(bytes_by_process(reading).values())
        driver_bytes = self.driver_bytes if self.driver_seen else 0
        return max(0, reading.used_bytes - listed_bytes - driver_bytes)

    def charge_bytes(self, lease: LeaseId) -> int:
        """Return what is charged for a lease; 0 where nothing is."""
        charge = self.charges.get(lease)
        return 0 if charge is None else charge.charged_bytes

    def charged_to(self, process: ProcessKey) -> int:
        """Return what a process is charged; it may be known by its pid alone, as in a reading."""
        account = self.accounts.get(process) or self._named_by_pid(process)
        return 0 if account is None else account.charged_bytes

    def total_if(
        self,
        leaving: Mapping[LeaseId, int] = NOTHING,
        joining: Collection[tuple[ProcessKey, int]] = (),
        *,
        stowaways: bool = True,
    ) -> int:
        """Return the total if some leases left (each retaining the bytes given) and processes got
        so many more, beside stowaways or without."""
        total = self._held_bytes + (self.stowaway_bytes if stowaways else 0)
        more: dict[Account, int] = {}  # what joins, less the charges that leave
        kept: dict[Account, int] = {}  # where leases leave: the least that their process retains
        for process, count in joining:
            account = self.accounts.get(process)
            if account is not None:
                more[account] = count
            else:
                held_bytes = self._stowaway_bytes(process) if stowaways else 0
                total += max(0, count - held_bytes)
        for lease, retained_bytes in leaving.items():
            charge = self.charges.get(lease)
            if charge is not None:
                account = charge.account
                more[account] = more.get(account, 0) - charge.charged_bytes
                floor_bytes = kept.get(account, account.retained_floor_bytes)
                kept[account] = max(floor_bytes, retained_bytes)
        for account, more_bytes in more.items():
            least_bytes = kept.get(account)
            if least_bytes is None:
                least_bytes = max(account.retained_bytes, account.measured_bytes)
            total += max(account.leased_bytes + more_bytes, least_bytes) - account.held_bytes
        return total

    def after_bytes(
        self, process: ProcessKey, going: Mapping[LeaseId, int], *, dead: bool
    ) -> tuple[int, int]:
        """Return what a process, and what all together, may still hold once these leases of it are
        gone: the most that a verification expects.

        A dead process without other debts retains nothing.
        """
        total = self.total_bytes()
        account = self.accounts.get(process)
        if account is None:
            return 0, total
        held = account.leased_bytes - sum(self.charge_bytes(lease) for lease in going)
        if not dead:
            held = max(held, account.retained_floor_bytes, *going.values())
        return held, total - account.held_bytes + held

    def leftover_bytes(self, account: Account, reading: MemorySampled, *, gone: bool) -> int:
        """Return the most that a reading leaves a process without leases of its retained bytes.

        `gone`: its process has no connection, so that a list that omits it may say that nothing is
        left.
        """
        process, least_bytes = account.process, account.retained_floor_bytes
        held_bytes = account.measured_bytes
        if bytes_of(reading, process) is None:  # listed without its bytes
            return max(least_bytes, reading.used_bytes)
        if gone and not held_bytes:
            least_bytes = 0
        if bytes_of(reading, process, omitted=None) is None:  # not listed
            unlisted_bytes = self.unlisted_bytes(reading)
            held_bytes = account.retained_bytes if unlisted_bytes is None else unlisted_bytes
        return max(least_bytes, held_bytes)

    # -- changing
    def charge(
        self,
        lease: LeaseId,
        process: ProcessKey,
        charged_bytes: int,
        approved_bytes: int,
        now: float,
    ) -> None:
        """Charge a grant, or after a restart what a holder reports."""
        account = self.accounts.get(process) or self._open(process)
        self._change(lease, Charge(account, charged_bytes, approved_bytes), now)

    def recharge(self, lease: LeaseId, charged_bytes: int, now: float) -> None:
        """Charge what a holder says it holds: what exceeds the grant was never approved."""
        before = self.charges[lease]
        approved_bytes = min(before.approved_bytes, charged_bytes)
        self._change(lease, Charge(before.account, charged_bytes, approved_bytes), now)

    def withdraw(self, lease: LeaseId, now: float) -> None:
        """Take a grant back that was never sent: the account is as it was before."""
        self._change(lease, None, now)

    def drop(self, lease: LeaseId, retained_bytes: int, floor_bytes: int, now: float) -> int:
        """The bytes of a lease returned but for what its process retains. Return what it is charged
        for that, `floor_bytes` of it declared.

        Never more than was charged before: what a process holds beyond that is evidence, not a
        charge.
        """
        account = self.charges[lease].account
        floor_bytes = max(account.retained_floor_bytes, floor_bytes)
        account.retained_bytes = min(max(retained_bytes, floor_bytes), account.approved_bytes)
        account.retained_floor_bytes = min(floor_bytes, account.retained_bytes)
        self._change(lease, None, now)
        return account.retained_bytes

    def retain(
        self, process: ProcessKey, retained_bytes: int, now: float, floor_bytes: int = 0
    ) -> None:
        """Charge (or, with 0, forget) what a process retains outside its leases; `floor_bytes` of
        it were declared."""
        account = self.accounts.get(process) or self._open(process)
        account.retained_bytes = retained_bytes
        floor_bytes = max(account.retained_floor_bytes, floor_bytes)
        account.retained_floor_bytes = min(floor_bytes, retained_bytes)
        account.changed_at, account.measured_bytes = now, 0
        self._count(account)

    def observe(self, reading: MemorySampled, *, quiet: bool, pending_bytes: int = 0) -> None:
        """Take the evidence of a reading.

        Args:
            quiet: Whether no lease loads or unloads, so that unattributed bytes mean something.
            pending_bytes: How many of the unattributed bytes may be pending free.
        """
        explained_bytes, complete = self.charged_bytes, not self.accounts
        if reading.processes is not None:
            explained_bytes, complete = self._take_list(reading)
        if not quiet:
            return
        # the driver's own up to the reserve, a process's beyond it; what may be pending free is
        # neither, if it is new
        reserve = self.info.reserve_bytes
        rest_bytes = max(0, reading.used_bytes - explained_bytes)
        stays_bytes = max(0, rest_bytes - pending_bytes)
        least, most = max(0, stays_bytes - reserve), max(0, rest_bytes - reserve)
        unattributed_bytes = min(max(self.unattributed_bytes, least), most)
        self.stowaway_bytes += unattributed_bytes - self.unattributed_bytes
        self.unattributed_bytes = unattributed_bytes
        least, most = min(stays_bytes, reserve), min(rest_bytes, reserve)
        if complete and self.driver_seen:
            self.driver_bytes = min(max(self.driver_bytes, least), most)
        elif complete and least == most:
            self.driver_bytes, self.driver_seen = most, True

    def _take_list(self, reading: MemorySampled) -> tuple[int, bool]:
        """Take bytes per process. Return the bytes explained, and whether the list explains all."""
        shown: dict[Account, int] = {}
        self.stowaways = {}
        for use in reading.processes or ():
            account = self.accounts.get(use.process) or self._named_by_pid(use.process)
            if account is None:
                self.stowaways[use.process] = use
            elif use.used_bytes is not None:
                shown[account] = use.used_bytes
                account.shown_in = reading if use.used_bytes else account.shown_in
        explained_bytes = sum([use.held_bytes for use in self.stowaways.values()])
        self.stowaway_bytes = explained_bytes + self.unattributed_bytes
        complete = None not in [use.used_bytes for use in reading.processes or ()]
        for account in self.accounts.values():
            count = shown.get(account)
            if reading.taken_at > account.changed_at and account.measured_bytes != (count or 0):
                account.measured_bytes = count or 0
                self._count(account)
            if count is None:
                # The list may omit a process that is dying or in another container: unattributed
                # bytes are its own first, up to its charge, and no stowaway's.
                count = account.charged_bytes
                complete = complete and not count
            explained_bytes += count
        return explained_bytes, complete

    def _named_by_pid(self, listed: ProcessKey) -> Account | None:
        """Return the account of a process that a reading knows by its pid alone."""
        if listed.start_ticks:
            return None
        named = (one for process, one in self.accounts.items() if process.pid == listed.pid)
        return next(named, None)

    def _open(self, process: ProcessKey) -> Account:
        """Return the new account of a process, which is no stowaway from now on."""
        for listed in (process, ProcessKey(process.pid, 0)):
            if listed in self.stowaways:
                self.stowaway_bytes -= self.stowaways.pop(listed).held_bytes
        account = self.accounts[process] = Account(process)
        return account

    def _stowaway_bytes(self, process: ProcessKey) -> int:
        """Return what a process without an account holds; the list may know its pid alone."""
        for listed in (process, ProcessKey(process.pid, 0)):
            if listed in self.stowaways:
                return self.stowaways[listed].held_bytes
        return 0

    # -- kept sums
    def _change(self, lease: LeaseId, charge: Charge | None, now: float) -> None:
        """The one place where charges change. None: the charge goes."""
        before = self.charges.get(lease)
        account = (charge or self.charges[lease]).account
        for one, sign in ((before, -1), (charge, 1)):
            if one is not None:
                account.leased_bytes += sign * one.charged_bytes
                account.leased_approved_bytes += sign * one.approved_bytes
        self.touched.add(lease)
        if charge is None:
            del self.charges[lease], account.charges[lease]
        else:
            self.charges[lease] = account.charges[lease] = charge
        account.changed_at, account.measured_bytes = now, 0  # older evidence says nothing of it
        self._count(account)

    def _count(self, account: Account) -> None:
        """Bring what an account holds, and the sums over all accounts, up to date; close it if it
        is empty."""
        retained, measured = account.retained_bytes, account.measured_bytes
        charged = max(account.leased_bytes, retained)
        approved = max(account.leased_approved_bytes, retained)
        held = max(charged, measured)
        self.charged_bytes += charged - account.charged_bytes
        self.approved_bytes += approved - account.approved_bytes
        self._held_bytes += held - account.held_bytes
        account.charged_bytes, account.approved_bytes = charged, approved
        account.held_bytes = held
        if not account.charges and not retained:
            del self.accounts[account.process]


@dataclass(slots=True)
class HostRam:
    """Host RAM for parked weights, by lease. A budget of 0: nothing is parked."""

    budget_bytes: int
    booked: dict[LeaseId, int] = field(default_factory=dict)
    found: set[LeaseId] = field(default_factory=set)
    """Booked as found after a restart, whatever the budget is now."""

    def taken_bytes(self) -> int:
        """Return what is booked for all leases together."""
        return sum(self.booked.values())

    def fitted_bytes(self) -> int:
        """Return what is booked because it fitted."""
        return sum(count for lease, count in self.booked.items() if lease not in self.found)

    def fits(self, lease: LeaseId, count: int) -> bool:
        """Return whether bytes fit in place of what is booked for the lease already."""
        others = self.taken_bytes() - self.booked.get(lease, 0)
        return others + count <= self.budget_bytes

    def book(self, lease: LeaseId, count: int) -> bool:
        """Book bytes in place of what is booked already. Return whether there are bytes to book
        and they fit."""
        if not count or not self.fits(lease, count):
            return False
        self.booked[lease] = count
        self.found.discard(lease)
        return True

    def find(self, lease: LeaseId, count: int) -> None:
        """Book bytes that are there already, fitting or not: the budget may have changed."""
        self.booked[lease] = count
        self.found.add(lease)

    def free(self, lease: LeaseId) -> None:
        """The weights of a lease are not in host RAM any more."""
        self.booked.pop(lease, None)
        self.found.discard(lease)


# -- what a reading tells
def bytes_by_process(reading: MemorySampled) -> dict[ProcessKey, int]:
    """Return the bytes of the listed processes; 0 where the driver does not say."""
    return {use.process: use.held_bytes for use in reading.processes or ()}


def bytes_of(reading: MemorySampled, process: ProcessKey, *, omitted: int | None = 0) -> int | None:
    """Return the bytes of a process; None: the reading cannot tell.

    An omitted process may hold bytes: it may live in a container that the driver cannot name, or be
    dying.

    Args:
        omitted: What to return for a process that the list omits.
    """
    for use in reading.processes or ():
        listed = use.process
        if listed == process or (listed.start_ticks == 0 and listed.pid == process.pid):
            return use.used_bytes
    return None if reading.processes is None else omitted
