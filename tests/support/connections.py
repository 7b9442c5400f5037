"""Connections without a socket, for tests of sessions: what is sent is kept, decoded."""

import os
from typing import Any

import msgpack

from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.runtime.procfs import start_ticks


def peer_of(pid: int, uid: int | None = None, gid: int | None = None) -> Peer:
    """The peer that a living process would be; `uid` and `gid` are this process's unless given. Its
    pidfd is none."""
    ticks = start_ticks(pid)
    assert ticks is not None, f"process {pid} has ended"
    own_uid, own_gid = os.getuid() if uid is None else uid, os.getgid() if gid is None else gid
    return Peer(ProcessKey(pid, ticks), own_uid, own_gid, -1)


class KeptConnection:
    """The shape of `schemas.runtime.connection.Connection`. It is reachable until it is closed, or
    told otherwise."""

    def __init__(self, serial: int, peer: Peer) -> None:
        self.serial = serial
        self.peer = peer
        self.admitted = False
        self.reachable = True
        self.closed = ""
        self.sent: list[dict[str, Any]] = []

    def admit(self) -> None:
        self.admitted = True

    def send(self, payload: bytes) -> bool:
        if self.reachable:
            self.sent.append(msgpack.unpackb(payload))
        return self.reachable

    def close(self, reason: str) -> None:
        self.reachable, self.closed = False, reason
