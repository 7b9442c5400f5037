"""Several users at one daemon: what all processes of one user take leaves room and time for
another. Real users, so it needs root."""

import grp
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack

import pytest

from tests.support.process import ArbiterProcess

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(os.getuid() != 0, reason="needs root to act as other users"),
]
GREEDY, OTHER = 54_321, 54_322
SESSIONS_MAX, PROCESSES = 40, 4
AS_USER = """
import json, os, sys
from tests.support.wire import WireClient
endpoint, uid, gid = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
os.setgroups([gid]); os.setresgid(gid, gid, gid); os.setresuid(uid, uid, uid)
"""
TAKE_ALL = (
    AS_USER
    + """
clients = [WireClient(endpoint) for _ in range(20)]
codes = []
for n, client in enumerate(clients):
    said = client.ask("hello", name="greedy", instance=f"{os.getpid()}-{n}")
    codes.append("ok" if said["ok"] else said["error"]["details"]["limit"])
print(json.dumps(codes), flush=True)
sys.stdin.read()
"""
)
ASK = (
    AS_USER
    + """
with WireClient(endpoint) as client:
    said = client.ask("hello", name="other", instance="other")
    print(json.dumps(client.ask("status")["clients"] if said["ok"] else said))
"""
)


def start_user(arbiter: ArbiterProcess, script: str, uid: int, gid: int) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", script, arbiter.endpoint, str(uid), str(gid)],
        env=arbiter.environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_the_processes_of_one_user_leave_room_for_another(
    make_arbiter: Callable[..., ArbiterProcess],
) -> None:
    """One peer took every session: no other user, and no operator, could connect."""
    group = next(g for g in grp.getgrall() if g.gr_gid != 0)
    limits = (
        f"sessions_max: {SESSIONS_MAX}, process_share: 0.25, user_share: 0.5, operator_reserve: 2"
    )
    arbiter = make_arbiter(config=f"limits: {{{limits}}}\nwire: {{group: {group.gr_name}}}\n")
    arbiter.runtime.chmod(0o755)
    arbiter.start()
    codes: list[str] = []
    with ExitStack() as ended:
        for _ in range(PROCESSES):
            greedy = start_user(arbiter, TAKE_ALL, GREEDY, group.gr_gid)
            ended.callback(greedy.communicate)
            assert greedy.stdout is not None
            codes += json.loads(greedy.stdout.readline())
        assert codes.count("ok") == SESSIONS_MAX / 2
        assert set(codes) == {"ok", "process_share", "user_share"}
        out, _ = start_user(arbiter, ASK, OTHER, group.gr_gid).communicate(timeout=60)
        assert json.loads(out) == SESSIONS_MAX / 2 + 1
