"""Whatever arrives is a request or a typed error, quickly, in little memory, and the answer to it
can be sent and is short."""

import random
import tracemalloc

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings
from pydantic import ValidationError

from tests.support.costly import COSTLY
from tests.support.hostile import ANSWER_MAX_BYTES, BOMBS, Forger, code_of, pack
from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES, MIB, VALUES_MAX
from vram_arbiter.schemas.errors import MessageTooLarge
from vram_arbiter.schemas.ids import RequestId
from vram_arbiter.schemas.runtime.msgpack_codec import count_values
from vram_arbiter.schemas.wire.requests import REQUESTS, Bye, Envelope

RANDOM = st.randoms(use_true_random=False)
SETTINGS = settings(deadline=None, suppress_health_check=list(HealthCheck))


@SETTINGS
@given(RANDOM, st.sampled_from(sorted(REQUESTS)))
def test_the_forger_knows_every_op_of_the_wire(draw: random.Random, op: str) -> None:
    assert code_of(pack(Forger(draw).request(op))) == "ok"


@SETTINGS
@given(RANDOM)
def test_a_frame_of_any_kind_is_a_request_or_a_typed_error(draw: random.Random) -> None:
    assert code_of(Forger(draw).frame()) in (
        "ok", "bad_frame", "bad_request", "unknown_op", "message_too_large"
    )  # fmt: skip


@SETTINGS
@given(RANDOM, st.sampled_from(sorted(REQUESTS)))
def test_a_mutated_request_keeps_its_id_in_the_answer(draw: random.Random, op: str) -> None:
    forger = Forger(draw)
    mutant = forger.mutant(forger.request(op, id=77))
    refused: codec.Undecodable | None = None
    try:
        envelope, _ = codec.decode(pack(mutant), MESSAGE_MAX_BYTES)
    except codec.Undecodable as bad:
        refused = bad
    if refused is None:
        assert envelope.id == mutant["id"]
        return
    expected = mutant.get("id") if isinstance(mutant, dict) else None
    whole = type(expected) is int and 0 <= expected < 1 << 53
    read = refused.error.code in ("bad_request", "unknown_op")
    assert refused.request_id == (expected if whole and read else None)


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_defused_in_little_memory(name: str) -> None:
    frame = BOMBS[name]
    # whatever is made once is made now
    codec.decode(pack({"op": "ping", "id": 1}), MESSAGE_MAX_BYTES)
    tracemalloc.start()
    try:
        found = code_of(frame)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found in ("bad_frame", "bad_request", "message_too_large") or name in (
        "duplicate keys", "id that is true"
    )  # fmt: skip
    assert peak_bytes < MIB + 2 * len(frame)


@pytest.mark.parametrize("name", COSTLY)
def test_the_costliest_messages_are_little_work(name: str) -> None:
    """What is built is counted, not timed (`make bench` does that): values, errors of validation,
    and the answer's bytes."""
    message = COSTLY[name]
    assert len(message) <= MESSAGE_MAX_BYTES + 200_000, "it is of the size that a client may send"
    refused: codec.Undecodable | None = None
    try:
        codec.decode(message, MESSAGE_MAX_BYTES)
    except codec.Undecodable as bad:
        refused = bad
    if refused is not None:
        assert len(codec.refusal(refused.request_id, 1, refused.error.view())) <= ANSWER_MAX_BYTES
        if isinstance(refused.__cause__, ValidationError):
            assert refused.__cause__.error_count() <= 5 * codec.KEYS_MAX
        if isinstance(refused.error, MessageTooLarge):
            return  # nothing was built
    assert count_values(message, 1 << 30) <= VALUES_MAX


def test_of_a_duplicate_key_the_last_counts_and_only_once() -> None:
    assert codec.decode(BOMBS["duplicate keys"], MESSAGE_MAX_BYTES) == (
        Envelope(RequestId(2)),
        Bye(),
    )
