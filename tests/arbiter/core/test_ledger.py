"""Bytes of one GPU: folding of residues, debts, evidence, stowaways."""

from dataclasses import replace

import pytest

from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.ledger import GpuLedger, bytes_of
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.notes import OverHolder, PressureNote

A, B, C = ProcessKey(1, 1), ProcessKey(2, 2), ProcessKey(3, 3)
LA, LA2, LB = LeaseId("La"), LeaseId("La2"), LeaseId("Lb")
GPU = GpuId("GPU-0")


def ledger() -> GpuLedger:
    return GpuLedger(
        GpuInfo(GPU, 0, "gpu", capacity_bytes=1000, reserve_bytes=100), tolerance_bytes=10
    )


def driver_bytes(books: GpuLedger) -> int | None:
    """The driver's own bytes; None while they were never seen."""
    return books.driver_bytes if books.driver_seen else None


def sample(at: float, used: int, *processes: tuple[ProcessKey, int | None]) -> MemorySampled:
    listed = tuple(ProcessUse(process, f"p{process.pid}", count) for process, count in processes)
    return MemorySampled(GPU, at, used, 1000, listed)


def test_a_residue_is_folded_into_the_next_lease_of_its_process() -> None:
    books = ledger()
    books.charge(LA, A, 500, 500, 1.0)
    assert books.drop(LA, 50, 50, 2.0) == 50
    assert books.total_bytes() == 50
    assert books.total_if(joining=[(A, 300)]) == 300, "not 350: the context is shared"
    assert books.total_if(joining=[(B, 300)]) == 350
    books.charge(LA2, A, 300, 300, 3.0)
    assert books.total_bytes() == 300
    assert books.drop(LA2, 0, 0, 4.0) == 50, "what was declared once stays while the process lives"


def test_two_leases_of_one_process_share_one_context() -> None:
    books = ledger()
    books.charge(LA, A, 300, 300, 1.0)
    books.charge(LA2, A, 200, 200, 1.0)
    assert books.total_if({LA: 50}) == 200
    assert books.total_if({LA: 50, LA2: 50}) == 50
    assert books.after_bytes(A, {LA: 50}, dead=False) == (200, 200)
    assert books.after_bytes(A, {LA: 50, LA2: 50}, dead=False) == (50, 50)
    assert books.after_bytes(A, {LA: 0, LA2: 0}, dead=True) == (0, 0)
    assert books.after_bytes(C, {}, dead=True) == (0, 500)
    assert books.drop(LA, 50, 50, 2.0) == 50
    assert books.total_bytes() == 200


def test_leaving_leases_that_are_not_here_change_nothing() -> None:
    books = ledger()
    books.charge(LA, A, 300, 300, 1.0)
    assert books.total_if({LB: 0}) == 300
    assert books.charge_bytes(LB) == 0


def test_a_residue_is_never_more_than_what_was_charged() -> None:
    books = ledger()
    books.charge(LA, A, 40, 40, 1.0)
    assert books.drop(LA, 450, 450, 2.0) == 40


def test_an_account_without_bytes_is_closed() -> None:
    books = ledger()
    books.charge(LA, A, 300, 300, 1.0)
    assert books.drop(LA, 0, 0, 2.0) == 0
    assert A not in books.accounts


def test_what_a_holder_says_beyond_its_grant_is_booked_but_not_approved() -> None:
    books = ledger()
    books.charge(LA, A, 500, 500, 1.0)
    books.recharge(LA, 700, 2.0)
    assert (books.charged_bytes, books.approved_bytes) == (700, 500)
    books.recharge(LA, 400, 3.0)
    assert (books.charged_bytes, books.approved_bytes) == (400, 400)


def test_evidence_counts_only_above_the_booking_and_only_if_it_is_new() -> None:
    books = ledger()
    books.charge(LA, A, 500, 500, 10.0)
    books.observe(sample(9.0, 700, (A, 700)), quiet=True)
    assert books.total_bytes() == 500, "a reading from before the grant says nothing about it"
    books.observe(sample(11.0, 505, (A, 505)), quiet=True)
    assert books.total_bytes() == 505
    books.observe(sample(12.0, 700, (A, 700)), quiet=True)
    assert books.total_bytes() == 700
    assert books.accounts[A].held_bytes - books.accounts[A].charged_bytes == 200
    assert books.total_if({LA: 0}) == 0
    assert books.total_if(joining=[(B, 100)]) == 800
    books.observe(sample(13.0, 0), quiet=True)
    assert books.total_bytes() == 500, "gone from the list: only the booking counts"
    assert books.accounts[A].measured_bytes == 0


def test_pressure_is_what_exceeds_the_budget() -> None:
    books = ledger()
    books.charge(LA, A, 800, 800, 1.0)
    assert books.pressure_bytes() == 0
    books.observe(sample(2.0, 910, (A, 800), (C, 110)), quiet=True)
    assert books.pressure_bytes() == 0, "within the tolerance"
    books.observe(sample(3.0, 950, (A, 800), (C, 150)), quiet=True)
    assert books.pressure_bytes() == 50


def test_a_note_of_pressure_names_holders_beyond_the_tolerance() -> None:
    books = ledger()
    books.charge(LA, A, 400, 400, 1.0)
    books.charge(LB, B, 300, 300, 1.0)
    books.observe(sample(2.0, 1021, (A, 410), (B, 311), (C, 300)), quiet=True)
    assert books.note_pressure() == PressureNote(GPU, 121, 300, (OverHolder(B.pid, 11),))
    assert books.note_pressure() is None
    books.observe(sample(3.0, 700, (A, 400), (B, 300)), quiet=True)
    assert books.note_pressure() == PressureNote(GPU, 0, 0, ())


def test_stowaways_are_named_and_leave_no_trace_once_they_lease() -> None:
    books = ledger()
    books.observe(sample(1.0, 240, (A, 200), (C, 40)), quiet=True)
    assert {s.process: s.held_bytes for s in books.stowaways.values()} == {A: 200, C: 40}
    assert books.total_bytes() == 240
    assert books.total_if(joining=[(A, 500)]) == 540, "its bytes become part of its lease"
    assert books.total_if(joining=[(A, 100)]) == 240
    books.charge(LA, A, 500, 500, 2.0)
    assert books.total_bytes() == 540


def test_a_process_known_by_pid_alone_is_found() -> None:
    books = ledger()
    unknown_start = ProcessKey(A.pid, 0)
    books.observe(sample(1.0, 200, (unknown_start, 200)), quiet=True)
    assert books.total_if(joining=[(A, 500)]) == 500
    books.charge(LA, A, 500, 500, 2.0)
    assert (books.total_bytes(), books.stowaways) == (500, {}), "the holder is not a stowaway"
    books.observe(sample(3.0, 600, (unknown_start, 600), (ProcessKey(77, 0), 5)), quiet=True)
    assert books.accounts[A].held_bytes - books.accounts[A].charged_bytes == 100
    assert [s.process.pid for s in books.stowaways.values()] == [77]


def test_an_unexplained_rest_counts_only_while_nobody_loads() -> None:
    books = ledger()
    books.observe(sample(1.0, 400, (C, 100)), quiet=False)
    assert (books.unattributed_bytes, driver_bytes(books)) == (0, None)
    books.observe(sample(2.0, 400, (C, 100)), quiet=True)
    assert (books.unattributed_bytes, driver_bytes(books)) == (200, 100), (
        "100 of 300 lie within the fixed reserve"
    )
    books.observe(sample(3.0, 150, (C, 100)), quiet=True)
    assert (books.unattributed_bytes, driver_bytes(books)) == (0, 50)
    assert books.unlisted_bytes(sample(4.0, 350, (C, 100))) == 200, "the driver's own are known"


def test_processes_without_byte_counts_are_taken_at_their_booking() -> None:
    books = ledger()
    books.charge(LA, A, 500, 500, 1.0)
    books.observe(sample(2.0, 800, (A, None), (C, None)), quiet=True)
    assert books.unattributed_bytes == 200
    assert driver_bytes(books) is None, "an incomplete list says nothing of the driver's own bytes"
    assert books.stowaways[C].held_bytes == 0


def test_a_backend_without_lists_gives_totals_only() -> None:
    books = ledger()
    books.observe(MemorySampled(GPU, 1.0, 30, 1000, None), quiet=True)
    assert (driver_bytes(books), books.unattributed_bytes) == (30, 0)
    books.charge(LA, A, 500, 500, 2.0)
    books.observe(MemorySampled(GPU, 3.0, 700, 1000, None), quiet=False)
    assert books.unattributed_bytes == 0
    books.observe(MemorySampled(GPU, 4.0, 700, 1000, None), quiet=True)
    assert books.unattributed_bytes == 100
    assert driver_bytes(books) == 30


def test_bytes_of_a_process_in_a_reading() -> None:
    reading = sample(1.0, 500, (A, 300), (B, None), (ProcessKey(3, 0), 9))
    assert [bytes_of(reading, p) for p in (A, B, C, ProcessKey(4, 4))] == [300, None, 9, 0]
    assert bytes_of(MemorySampled(GPU, 1.0, 5, 10, None), A) is None


def test_leases_that_leave_together_keep_the_largest_of_their_residues() -> None:
    books = ledger()
    books.charge(LA, A, 300, 300, 1.0)
    books.charge(LA2, A, 200, 200, 1.0)
    assert books.total_if({LA: 50, LA2: 20}) == books.total_if({LA: 20, LA2: 50}) == 50


def test_while_the_drivers_own_bytes_were_never_seen_none_are_known() -> None:
    books = ledger()
    assert books.unlisted_bytes(sample(1.0, 150, (C, 100))) == 50, "another container's, maybe"


@pytest.mark.parametrize(
    ("used", "total", "held", "says"),
    [
        (1010, 1000, 1010, ""),
        (0, 990, 0, ""),
        (0, 989, 0, "989 bytes of memory, 1000 are leased out"),
        (1011, 1000, 0, "1011 of 1000 bytes are used"),
        (-1, 1000, 0, "-1 of 1000 bytes are used"),
        (500, 1000, 1011, "process 2 holds 1011 of 1000 bytes"),
        (500, 1000, -1, "process 2 holds -1 of 1000 bytes"),
    ],
)
def test_a_reading_is_impossible_beyond_the_tolerance(
    used: int, total: int, held: int, says: str
) -> None:
    """One process may hold the whole GPU; the second of the list is looked at too."""
    reading = replace(sample(1.0, used, (A, None), (B, held)), total_bytes=total)
    assert ledger().impossible(reading) == (says and f"impossible reading: {says}")


def test_bytes_that_may_be_pending_free_are_neither_unattributed_nor_the_drivers() -> None:
    books = ledger()
    books.observe(sample(1.0, 250), quiet=True, pending_bytes=250)
    assert (books.unattributed_bytes, driver_bytes(books)) == (0, None), "all of it may be"
    books.observe(sample(2.0, 250), quiet=True, pending_bytes=100)
    assert (books.unattributed_bytes, driver_bytes(books)) == (50, 100)
    books.observe(sample(3.0, 120), quiet=True, pending_bytes=80)
    assert (books.unattributed_bytes, driver_bytes(books)) == (20, 100), "20 of 50 are still there"
    books.observe(sample(4.0, 70), quiet=True, pending_bytes=30)
    assert (books.unattributed_bytes, driver_bytes(books)) == (0, 70)
    assert books.total_bytes() == 0
