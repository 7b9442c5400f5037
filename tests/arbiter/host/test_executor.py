"""Effects are performed in order, and nothing is said about a grant that could not be
written down."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from tests.support.messages import lease_view, revoke
from vram_arbiter.arbiter.core import effects as fx
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.model.records import DrainRecord
from vram_arbiter.arbiter.core.model.refusals import LeaseOver
from vram_arbiter.arbiter.host.executor import Executor
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas.errors import JournalUnavailable
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.notes import About, GrantedNote, ReleasedNote, RevokeAskedNote
from vram_arbiter.schemas.wire.pushes import GrantedPush, RevokeWithdrawnPush
from vram_arbiter.schemas.wire.replies import AcquireReply, StateReply

A, ONE, GPU = ClientId("aa"), RequestId(1), GpuId("GPU-1")
LEASE = AcquireReply("loading", lease_view())
GRANTED = GrantedPush(lease_view())
RECORD = DrainRecord("operator", "service")
WRITTEN = {"by": "operator", "reason": "service"}
ABOUT = About(LeaseId("L1-1"), "det", GPU)
REVOKE = revoke("L1-9")
WITHDRAWN = RevokeWithdrawnPush("L1-1", Token(1, 2))


class Recorder:
    """Writes down, in order, whatever is done."""

    def __init__(self, *, disk_full: bool = False) -> None:
        self.done: list[tuple[Any, ...]] = []
        self.disk_full = disk_full
        self.executor = Executor(
            self, self, self, self.sample, self.post, self.log_event, self.signal, words
        )

    def reply(self, client: ClientId, request: RequestId, body: object) -> None:
        self.done.append(("reply", client, request, body))

    def refuse(self, client: ClientId, request: RequestId, error: ErrorView) -> None:
        self.done.append(("refuse", client, request, error.code))

    def push(self, client: ClientId, body: object) -> None:
        self.done.append(("push", client, body))

    def broadcast(self, event: Mapping[str, Any]) -> None:
        self.done.append(("broadcast", event["kind"]))

    def apply(self, changes: Sequence[tuple[str, Mapping[str, Any] | None]]) -> None:
        if self.disk_full:
            raise JournalUnavailable("disk full")
        self.done.append(("journal", *changes))

    def append(self, kind: str, data: Mapping[str, Any]) -> Mapping[str, Any]:
        self.done.append(("history", kind))
        return {"kind": kind, **data}

    def sample(self, gpu: GpuId) -> None:
        self.done.append(("sample", gpu))

    def signal(self, process: ProcessKey, kind: str) -> None:
        self.done.append(("signal", process, kind))

    def post(self, event: ev.Event) -> None:
        self.done.append(("post", event))

    def log_event(self, event: Mapping[str, Any]) -> None:
        self.done.append(("log", event["kind"]))
        self.said = event


def test_a_signal_goes_to_whoever_watches_the_process() -> None:
    recorder = Recorder()
    recorder.executor.perform([fx.Signal(ProcessKey(7, 8), "term")])
    assert recorder.done == [("signal", ProcessKey(7, 8), "term")]


def test_answers_go_out_in_order_then_facts_then_readings() -> None:
    recorder = Recorder()
    recorder.executor.perform(
        [
            fx.JournalPut("lease:L1-1", RECORD),
            fx.JournalDelete("lease:L1-0"),
            fx.Reply(A, ONE, LEASE),
            fx.Push(A, REVOKE),
            fx.Sample(GPU),
            fx.Note(GrantedNote(5, 0.0, ()), ABOUT),
            fx.Refuse(A, ONE, LeaseOver("L1-1", "released")),
            fx.JournalDelete("lease:L1-1"),
        ]
    )
    assert recorder.done == [
        ("journal", ("lease:L1-1", WRITTEN), ("lease:L1-0", None), ("lease:L1-1", None)),
        ("reply", A, ONE, LEASE),
        ("push", A, REVOKE),
        ("refuse", A, ONE, "bad_state"),
        ("history", "granted"),
        ("log", "granted"),
        ("broadcast", "granted"),
        ("sample", GPU),
    ]


def test_a_grant_that_cannot_be_written_is_not_sent() -> None:
    recorder = Recorder(disk_full=True)
    recorder.executor.perform(
        [
            fx.JournalPut("lease:L1-1", RECORD, gates=True),
            fx.Reply(A, ONE, LEASE),
            fx.Note(GrantedNote(5, 0.0, ()), ABOUT),
            fx.Push(A, GRANTED),
            fx.Push(A, REVOKE),
            fx.Sample(GPU),
        ]
    )
    assert recorder.done == [
        ("post", ev.JournalFailed("lease:L1-1", "disk full")),
        ("refuse", A, ONE, "journal_unavailable"),
        ("push", A, REVOKE),
        ("sample", GPU),
    ]


def test_what_was_said_of_a_lease_before_its_grant_is_said_though_that_cannot_be_written() -> None:
    """Records are written first, for all that the batch says; it still waits for what came after
    the grant only."""
    recorder = Recorder(disk_full=True)
    recorder.executor.perform(
        [
            fx.JournalPut("lease:L1-0", RECORD),
            fx.Reply(A, RequestId(2), StateReply("verifying")),
            fx.Push(A, WITHDRAWN),
            fx.JournalPut("lease:L1-1", RECORD, gates=True),
            fx.Push(A, GRANTED),
        ]
    )
    assert recorder.done == [
        ("post", ev.JournalFailed("lease:L1-0", "disk full", gates=False)),
        ("post", ev.JournalFailed("lease:L1-1", "disk full")),
        ("reply", A, RequestId(2), StateReply("verifying")),
        ("push", A, WITHDRAWN),
    ]


def test_what_has_happened_is_told_though_its_record_cannot_be_written() -> None:
    """Regression: with a full disk a release was refused and missing in the history although it had
    taken place."""
    recorder = Recorder(disk_full=True)
    recorder.executor.perform(
        [
            fx.JournalPut("lease:L1-1", RECORD),
            fx.Note(ReleasedNote(False, "held", Why.LET_GO), ABOUT),
            fx.Reply(A, ONE, LEASE),
        ]
    )
    assert recorder.done == [
        ("post", ev.JournalFailed("lease:L1-1", "disk full", gates=False)),
        ("reply", A, ONE, LEASE),
        ("history", "released"),
        ("log", "released"),
        ("broadcast", "released"),
    ]


def test_a_record_that_cannot_be_deleted_stops_nobody() -> None:
    recorder = Recorder(disk_full=True)
    recorder.executor.perform([fx.JournalDelete("lease:L1-1"), fx.Reply(A, ONE, LEASE)])
    assert recorder.done == [("reply", A, ONE, LEASE)]


def test_a_record_that_a_full_disk_could_not_delete_goes_with_the_next_write() -> None:
    """Regression: it stayed for ever, and every restart recovered a lease that nobody had."""
    recorder = Recorder(disk_full=True)
    recorder.executor.perform(
        [fx.JournalDelete("lease:L1-1"), fx.JournalDelete("residue:1@1:GPU-1")]
    )
    recorder.disk_full = False
    recorder.executor.perform([fx.JournalPut("residue:1@1:GPU-1", RECORD)])
    recorder.executor.perform([fx.JournalDelete("lease:L1-2")])
    assert recorder.done == [
        ("journal", ("lease:L1-1", None), ("residue:1@1:GPU-1", WRITTEN)),
        ("journal", ("lease:L1-2", None)),
    ]


def test_a_record_that_is_written_again_is_not_deleted_later() -> None:
    recorder = Recorder(disk_full=True)
    recorder.executor.perform([fx.JournalDelete("residue:1@1:GPU-1")])
    recorder.executor.perform([fx.JournalPut("residue:1@1:GPU-1", RECORD)])
    recorder.disk_full = False
    recorder.executor.perform([fx.JournalDelete("lease:L1-2")])
    assert recorder.done[-1] == ("journal", ("lease:L1-2", None))


def test_what_is_owed_is_deleted_without_a_further_change() -> None:
    recorder = Recorder(disk_full=True)
    recorder.executor.perform([fx.JournalDelete("lease:L1-1")])
    recorder.executor.settle()
    assert recorder.done == [], "the disk is no better yet"
    recorder.disk_full = False
    recorder.executor.settle()
    recorder.executor.settle()
    assert recorder.done == [("journal", ("lease:L1-1", None))], "once"


def test_a_revoke_names_the_span_of_its_eviction_as_its_event_does() -> None:
    """The ids are minted before the push leaves, which is before the fact is written down."""
    recorder = Recorder()
    lease = LeaseId(REVOKE.lease_id)
    asked = RevokeAskedNote("policy", LeaseId("L1-9"), 0, "waiter")
    note = fx.Note(asked, About(lease, "det", GpuId("GPU-0")))
    given = f"00-{'a' * 32}-{'b' * 16}-01"
    recorder.executor.perform([fx.Push(A, replace(REVOKE, traceparent=given)), note])
    push = next(done[2] for done in recorder.done if done[0] == "push")
    event = recorder.said
    assert push.traceparent == f"00-{'a' * 32}-{event['span_id']}-01"
    assert event["trace_id"] == "a" * 32
    assert event["parent_id"] not in ("b" * 16, event["span_id"]), "the waiter's own span"


def test_writes_of_the_journal_are_counted() -> None:
    recorder = Recorder()
    recorder.executor.perform([fx.JournalPut("lease:L1-1", RECORD)])
    recorder.disk_full = True
    recorder.executor.perform([fx.JournalPut("lease:L1-2", RECORD)])
    writes = recorder.executor.writes
    assert (writes.count, writes.failures, writes.seconds >= 0) == (2, 1, True)
