"""What `vramctl` prints, to the letter."""

import re
import time
from pathlib import Path
from typing import Any

import pytest

import vram_arbiter.clients.observer.page as page
from vram_arbiter.clients.cli import text
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.wire.notes import NOTES

GPU = {
    "gpu": "GPU-1",
    "index": 0,
    "name": "Simulated GPU",
    "capacity_bytes": 8 * GIB,
    "reserve_bytes": 300 * MIB,
    "charged_bytes": 5 * GIB,
    "stowaway_bytes": 0,
    "measured_used_bytes": 5 * GIB + 100 * MIB,
    "sample_age_s": 0.42,
    "pressure_bytes": 0,
    "blocked": None,
    "processes": [],
}
LEASE = {
    "lease_id": "L1-1",
    "token": [1, 2],
    "state": "held",
    "consumer": "detector",
    "model": "m@r1",
    "gpu": "GPU-1",
    "mode": "shared",
    "priority": 50,
    "evictable": True,
    "charge_bytes": 5 * GIB,
    "uses": 1,
    "pid": 7,
    "since_s": 61.0,
}
STATUS = {
    "epoch": 3,
    "phase": "serving",
    "uptime_s": 720.0,
    "gpus": [GPU],
    "leases": [LEASE],
    "clients": 1,
}
WAITS = {
    "lease_id": "L1-3", "state": "queued", "needed_bytes": 4 * GIB, "free_bytes": 3 * GIB,
    "deficit_bytes": GIB, "condition": "making_room",
    "blockers": [
        {"lease_id": "L1-1", "consumer": "detector", "bytes": 5 * GIB, "state": "revoking",
         "uses": 1, "condition": "in_use", "text": "1 use running"},
    ],
    "next": "it unloads", "eta_s": 1.25, "eta_source": "learnt", "text": "grab needs room",
}  # fmt: skip


def test_status() -> None:
    queued = LEASE | {
        "lease_id": "L1-12",
        "consumer": "grab",
        "state": "queued",
        "uses": 0,
        "position": 1,
    }
    pinned = LEASE | {
        "lease_id": "L1-3",
        "consumer": "job",
        "uses": 0,
        "evictable": False,
        "charge_bytes": 450 * MIB,
    }
    assert text.status_lines(STATUS | {"leases": [LEASE, pinned, queued]}) == [
        "arbiter serving · epoch 3 · up 12 min · 1 client",
        "",
        "GPU 0 Simulated GPU (GPU-1)",
        "  capacity 8 GiB = reserve 300 MiB + charged 5 GiB + free 2.71 GiB",
        "  measured 5.1 GiB in use, 0.4 s ago",
        "",
        "LEASE  CONSUMER  MODEL  STATE                CHARGE  USES  PRIO  PID  SINCE",
        "L1-1   detector  m@r1   held, in use          5 GiB     1    50    7   61 s",
        "L1-3   job       m@r1   held, idle, pinned  450 MiB     0    50    7   61 s",
        "L1-12  grab      m@r1   queued #1             5 GiB     0    50    7   61 s",
    ]


def test_status_shows_the_sensors_that_are_known() -> None:
    """On a line of their own, and none where nothing is known."""
    sensors = {"utilization": 0.873, "temperature_c": 64.0, "power_w": 215.4}
    shown = text.status_lines(STATUS | {"gpus": [GPU | {"sensors": sensors}]})
    assert shown[5] == "  87 % busy, 64 °C, 215 W"
    assert text.sensors_text({"temperature_c": 0.0}) == "0 °C"


def test_status_counts_requests_at_consumers_with_and_without_a_lease() -> None:
    demands = [
        {"consumer": "detector", "in_flight": 3, "waiting": 0, "client": "vram-gateway"},
        {"consumer": "llm", "in_flight": 0, "waiting": 12, "client": "vram-gateway"},
    ]
    table = [
        "",
        "REQUESTS OF  IN FLIGHT  WAITING  TOLD BY",
        "detector             3        0  vram-gateway",
        "llm                  0       12  vram-gateway",
    ]
    assert text.status_lines(STATUS | {"demands": demands})[-4:] == table
    assert text.status_lines(STATUS | {"leases": [], "demands": demands})[-5:] == [
        "no leases",
        *table,
    ]


def test_status_says_what_is_wrong_with_the_daemons_own_files() -> None:
    problems = [
        "the journal cannot be written (disk full): what is held stays, nothing new is granted"
    ]
    assert text.status_lines(STATUS | {"problems": problems})[1] == f"  {problems[0]}"


def test_status_of_a_gpu_in_trouble() -> None:
    processes = [
        {"pid": 8, "name": "Xorg", "used_bytes": 200 * MIB, "residue_bytes": 0, "stowaway": True},
        {
            "pid": 7,
            "name": "python",
            "used_bytes": None,
            "residue_bytes": 450 * MIB,
            "stowaway": False,
        },
        {"pid": 9, "name": "python", "used_bytes": 1, "residue_bytes": 0, "stowaway": False},
    ]
    gpu = GPU | {
        "measured_used_bytes": None,
        "sample_age_s": None,
        "stowaway_bytes": 200 * MIB,
        "pressure_bytes": GIB,
        "blocked": {"code": "unreadable", "text": "the probe failed"},
        "processes": processes,
    }
    assert text.status_lines(
        STATUS | {"phase": "recovering", "gpus": [gpu], "leases": [], "clients": 2}
    ) == [
        "arbiter recovering · epoch 3 · up 12 min · 2 clients",
        "  restarted: nothing is granted until every lease is accounted for",
        "",
        "GPU 0 Simulated GPU (GPU-1)",
        "  capacity 8 GiB: reserve 300 MiB + charged 5 GiB + stowaways 200 MiB",
        "  measured: unknown (the probe fails), so nothing is granted",
        "  pressure: 1 GiB more than was granted",
        "  no grants now: the probe failed",
        "  stowaway pid 8 Xorg: 200 MiB without a lease",
        "  residue of pid 7 python: 450 MiB",
        "",
        "no leases",
    ]


def test_why_somebody_waits() -> None:
    assert text.why_lines({"consumer": "grab", "leases": [WAITS]}) == [
        "grab needs room",
        "  lease     L1-3, queued",
        "  bytes     needs 4 GiB, free 3 GiB, missing 1 GiB",
        "  blocked   by detector (L1-1): 5 GiB, revoking, 1 use running",
        "  next      it unloads",
        "  expected  in 1.2 s (learnt)",
    ]
    unknown = text.why_lines(
        {"consumer": "grab", "leases": [WAITS | {"eta_s": None, "eta_source": "none"}]}
    )
    assert unknown[-1] == "  expected  unknown"


def test_drift_is_a_column_only_where_somebody_drifts() -> None:
    def shown(*drifts: int) -> list[str]:
        leases = [LEASE | {"drift_bytes": drift} if drift else LEASE for drift in drifts]
        return text.status_lines(STATUS | {"leases": leases})[-len(drifts) - 1 :]

    assert "DRIFT" not in shown(0)[0]
    head, above, below, none = shown(GIB, -GIB // 2, 0)
    assert head.index("CHARGE") < head.index("DRIFT") < head.index("USES")
    assert ("+1 GiB" in above, "-512 MiB" in below, "+" in none) == (True, True, False)


def test_why_tells_what_is_planned() -> None:
    told = "asks detector in 1.2 s, when its minimum residency ends"
    entry = WAITS | {"plan": [{"action": "ask", "in_s": 1.2, "text": told}]}
    assert f"  then      {told}" in text.why_lines({"consumer": "grab", "leases": [entry]})


def test_why_tells_what_was_measured_before() -> None:
    parts = ("load_peak", "steady", "residue")
    never = {"declared_bytes": dict.fromkeys(parts, GIB), "learnt_bytes": dict.fromkeys(parts, 0)}
    entry = {"lease_id": "L1-1", "state": "held", "text": "detector: it is resident, idle"}

    def lines(footprint: dict[str, Any]) -> list[str]:
        return text.why_lines(
            {"consumer": "detector", "leases": [entry | {"footprint": footprint}]}
        )

    assert len(lines(never)) == 2
    assert lines(never | {"learnt_bytes": {"load_peak": 2 * GIB, "steady": GIB, "residue": 0}})[
        -1
    ] == (
        "  footprint load peak 1 GiB (measured 2 GiB), steady 1 GiB (measured 1 GiB), residue 1 GiB"
    )


def test_why_somebody_runs_or_is_not_there() -> None:
    entry = {"lease_id": "L1-1", "state": "held", "text": "detector: it is resident, idle"}
    assert text.why_lines({"consumer": "detector", "leases": [entry]}) == [
        "detector: it is resident, idle",
        "  lease     L1-1, held",
    ]
    (nobody,) = text.why_lines({"consumer": "x", "leases": []})
    assert nobody.startswith("x has no lease and waits for none (")
    assert "`vramctl history -c x`" in nobody


def test_an_event() -> None:
    event = {
        "seq": 4,
        "at_wall_s": 0.0625,
        "kind": "granted",
        "lease_id": "L1-1",
        "consumer": "a",
        "gpu": "GPU-1",
        "token": [1, 2],
        "reason": "fits",
        "charge_bytes": GIB,
        "waited_ms": 12.345,
        "evicted": ["b"],
        "share": 0.123456,
        "eta": None,
    }
    line = text.event_line(event)
    day = time.strftime("%Y-%m-%d", time.localtime(0))
    assert line.startswith(day + " "), (
        "the history is days long: without a date two nights look like one"
    )
    assert line.partition(":")[2].partition(":")[2] == (
        "00.062  granted         a L1-1  fits  charge=1GiB waited=12.3ms share=0.123"
    )


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ({"ms": 3512.4}, "took=3.5s"),  # was ms=3.51e+03
        ({"ms": 0.41}, "took=0.4ms"),
        ({"load_ms": 96_000}, "load=96.0s"),
        ({"drain_ms": 4.0}, "quiesce=4.0ms"),  # drain is the word for an operator's order
        ({"safe_point_eta_s": 0.25}, "safe_point_eta=250.0ms"),
        ({"pressure_bytes": 0}, "pressure=0B"),
        ({"resolved": True}, "resolved=True"),
        ({"share": 12_345.678}, "share=12345.678"),
    ],
)
def test_fields_of_an_event_have_units(field: dict[str, Any], said: str) -> None:
    """Regression: the history printed `ms=3.51e+03` and no dates."""
    assert text.event_line({"at_wall_s": 0.0, "kind": "verified", **field}).endswith(f"  {said}")


def test_the_page_folds_the_kinds_that_vramctl_folds() -> None:
    story = (Path(page.__path__[0]) / "static/story.js").read_text()
    listed = re.search(r"const QUIET = new Set\(\[(.*?)\]\);", story, re.DOTALL)
    assert set(re.findall(r'"(\w+)"', listed[1])) == text.QUIET_KINDS <= NOTES.keys()


def test_since_counts_from_the_grant() -> None:
    """It counted from the last change of state: a lease that was held for a day showed 2 s once it
    was revoked."""
    revoked = LEASE | {"state": "revoking", "since_s": 2.0, "granted_s": 90_000.0}
    away = LEASE | {
        "lease_id": "L1-2",
        "state": "standby",
        "gpu": None,
        "since_s": 3.0,
        "granted_s": 900.0,
    }
    lines = text.status_lines(STATUS | {"leases": [revoked, away]})
    assert [line.split("  ")[-1].strip() for line in lines[-2:]] == ["25 h", "3.0 s"]


def test_the_gpu_of_a_lease_is_a_column_where_there_are_several() -> None:
    second = GPU | {"gpu": "GPU-2", "index": 1}
    waits = LEASE | {"lease_id": "L1-2", "state": "queued", "gpu": None, "position": 1}
    status = STATUS | {"gpus": [GPU, second], "leases": [LEASE | {"gpu": "GPU-2"}, waits]}
    head, row, waiting = text.status_lines(status)[-3:]
    assert head.split()[:5] == ["LEASE", "CONSUMER", "MODEL", "GPU", "STATE"]
    assert row.split()[3] == "1"
    assert waiting.split()[3] == "queued", "a waiter has none yet"
    assert "GPU  STATE" not in "\n".join(text.status_lines(STATUS))


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.04, "0.0 s"),
        (9.96, "10.0 s"),
        (12, "12 s"),
        (180, "3 min"),
        (10_800, "3 h"),
        (200_000, "2 d"),
    ],
)
def test_durations(seconds: float, said: str) -> None:
    assert text.duration(seconds) == said
