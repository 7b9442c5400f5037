"""What a peer that the kernel named may be."""

import os

import pytest

from vram_arbiter.arbiter.rpc.peer import group_id, is_operator
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer


def peer(uid: int, gid: int, pid: int = 1) -> Peer:
    return Peer(ProcessKey(pid, 1), uid, gid, -1)


def test_operators_are_root_the_same_user_and_the_group() -> None:
    group = group_id("wire.group", "daemon")
    assert group is not None
    assert is_operator(peer(0, 0), None)
    assert is_operator(peer(os.getuid(), 0), None)
    assert not is_operator(peer(54_321, 54_321), None)
    assert not is_operator(peer(54_321, 54_321), group)
    assert is_operator(peer(54_321, group), group)
    assert is_operator(peer(1, 54_321), group)  # user `daemon` by its account
    assert group_id("wire.group", None) is None
    with pytest.raises(ConfigError, match="no group 'no-such-group-here'"):
        group_id("wire.group", "no-such-group-here")
