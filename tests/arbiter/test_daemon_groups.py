"""Two roles by group: `wire.group` may hold leases, `wire.operators_group` may act by hand.

Regression: with one group for both roles every holder could drain the arbiter.
Real daemon, real users.
"""

import grp
import json
import os
from typing import Any

import pytest

from tests.support.prepared import run
from tests.support.process import ArbiterProcess, Make

pytestmark = pytest.mark.e2e
NOBODY = 65534
CLIENT = """
import json, os, sys
from tests.support.wire import WireClient
endpoint, role, primary, other = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
os.setgroups([other]); os.setresgid(primary, primary, primary); os.setresuid(65534, 65534, 65534)
with WireClient(endpoint) as client:
    said = client.ask("hello", name="c", instance="c", role=role)
    if said["ok"]:
        client.granted("job", 1 << 30)
        said = client.ask("drain", reason="by hand")
    print(json.dumps(said))
"""


def groups() -> tuple[str, str]:
    """Two groups of this machine that neither root nor `nobody` is in by its account."""
    names = [
        g.gr_name
        for g in grp.getgrall()
        if g.gr_gid not in (0, NOBODY) and "nobody" not in g.gr_mem
    ]
    return names[0], names[1]


def speak(arbiter: ArbiterProcess, role: str, primary: str, other: str) -> dict[str, Any]:
    numbers = [str(grp.getgrnam(name).gr_gid) for name in (primary, other)]
    done = run("script", [CLIENT, arbiter.endpoint, role, *numbers], arbiter.environ, 60.0)
    assert done.returncode == 0, done.stderr
    said: dict[str, Any] = json.loads(done.stdout)
    return said


@pytest.mark.skipif(os.getuid() != 0, reason="needs root to act as other users")
def test_a_member_of_the_group_may_lease_and_only_operators_act_by_hand(make_arbiter: Make) -> None:
    """Every member of the socket's group could evict and drain: to hold a lease was to be an
    operator."""
    members, operators = groups()
    arbiter = make_arbiter(arguments=("--group", members, "--operators-group", operators))
    arbiter.runtime.chmod(0o755)
    arbiter.start()
    socket = (arbiter.runtime / "arbiter.sock").stat()
    assert socket.st_gid == grp.getgrnam(members).gr_gid
    refused = speak(arbiter, "operator", members, members)
    assert refused["error"]["code"] == "not_permitted"
    assert operators in refused["error"]["hint"], "the hint names the group"
    leased = speak(arbiter, "client", members, members)
    assert leased["error"]["message"] == "only an operator may drain", (
        "the lease was granted, no more"
    )
    assert speak(arbiter, "operator", operators, members)["ok"]
