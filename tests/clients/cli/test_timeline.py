"""`vramctl timeline`: the history of a real daemon and its event log tell one story, and each form
of it is what its readers expect."""

import contextlib
import importlib.util
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ArbiterProcess, vramctl
from tests.support.waiting import until
from vram_arbiter.clients.cli.timeline import chart, collect
from vram_arbiter.clients.cli.timeline.collect import BadEventLog, EmptyTimeline, Range
from vram_arbiter.clients.cli.timeline.command import write
from vram_arbiter.clients.cli.timeline.reader import Reader
from vram_arbiter.clients.cli.timeline.story import GpuStory, Mark, Story, within
from vram_arbiter.clients.cli.timeline.trace import trace
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.wire.requests import Acquire
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

PHASES = ["revoke", "quiesce", "unload", "verify"]
HOSTILE = "</title><script>x</script>\x1b[2J\u202e$x^2$&"


def spec(consumer: str, gib: float) -> LeaseSpec:
    size = int(gib * GIB)
    return LeaseSpec(
        consumer=consumer,
        model_id=consumer,
        footprint=Footprint(size, size, 0),
        min_residency_s=0.0,
        ttl_s=600.0,
    )


@pytest.fixture(scope="module")
def switched() -> Iterator[ArbiterProcess]:
    """A daemon on which `grab` waited for `detector`, which was in use and left for it; `encoder`
    is held all the time."""
    daemon = ArbiterProcess(prepared=True).start()
    try:
        with contextlib.ExitStack() as clients:
            detector, grab, encoder = (
                clients.enter_context(Client(name, endpoint=daemon.endpoint))
                for name in ("detector", "grab", "encoder")
            )
            encoder.acquire(spec("encoder", 0.5)).ready(GIB // 2)
            held = detector.acquire(spec("detector", 5))
            held.ready(5 * GIB)
            with held.use("detect"):
                # the other connection may be faster
                until(lambda: any(one.uses for one in encoder.status().leases))
                grab.ask(Acquire("grab", spec("grab", 6)))
            until_gone(detector)
            until(lambda: "loading" in logged_states(daemon).get("grab", []))
            yield daemon
    finally:
        daemon.close()


def until_gone(client: Client) -> None:
    """Wait until nothing waits."""
    while client.status().totals.waiting:
        pass


@pytest.fixture(scope="module")
def printed(switched: ArbiterProcess) -> Story:
    return collect.from_history(Range(last_s=3600.0), switched.endpoint)


def lease_states(story: Story) -> dict[str, list[str]]:
    return {one.consumer: [span.name for span in one.states] for one in story.leases}


def logged_states(daemon: ArbiterProcess) -> dict[str, list[str]]:
    """The states by the event log, which reaches the disk in batches: at first there is none."""
    try:
        return lease_states(collect.story_of(collect.read_log(daemon.state), Range()))
    except (BadEventLog, EmptyTimeline):
        return {}


# -- the story
@pytest.mark.e2e
def test_the_history_tells_waits_uses_states_and_phases(printed: Story) -> None:
    found = lease_states(printed)
    assert found["encoder"] == ["loading", "held"]
    assert found["detector"] == ["loading", "held", *PHASES]
    assert found["grab"] == ["queued", "loading"]
    detector, grab = (
        next(lease for lease in printed.leases if lease.consumer == name)
        for name in ("detector", "grab")
    )
    assert [use.name for use in detector.uses] == ["detect"]
    assert grab.states[0].note == "room is being made"
    assert grab.states[-1].going
    assert [count for _, count in detector.charges] == [5 * GIB, 5 * GIB, 0]
    (eviction,) = printed.evictions
    assert (eviction.consumer, eviction.wanted_by, eviction.verdict) == (
        "detector", "grab", "verified"
    )  # fmt: skip
    phases = detector.states[2:]
    assert eviction.asked_s == phases[0].begin_s
    assert eviction.end_s == phases[-1].end_s
    assert phases[0].begin_s <= detector.uses[0].end_s <= phases[2].begin_s
    assert printed.begin_s > printed.end_s - 600, "it begins with the daemon, not an hour ago"
    (gpu,) = printed.gpus
    assert gpu.capacity_bytes == 8 * GIB
    assert printed.bytes_by_name(gpu)["grab"][-1][1] == 6 * GIB


@pytest.mark.e2e
def test_the_event_log_tells_the_same_offline(switched: ArbiterProcess, printed: Story) -> None:
    read_back = collect.read_log(switched.state)
    logged = collect.story_of(read_back, Range())
    assert lease_states(logged) == lease_states(printed)
    (one,), (other,) = logged.evictions, printed.evictions
    assert (one.lease_id, one.verdict) == (other.lease_id, other.verdict)
    assert [[count for _, count in lease.charges] for lease in logged.leases] == [
        [count for _, count in lease.charges] for lease in printed.leases
    ]
    assert logged.gpus[0].gpu == printed.gpus[0].gpu
    assert logged.gpus[0].measured, "readings are in the log alone"
    ended = logged.end_s
    part = collect.story_of(read_back, Range(last_s=1e-3))
    assert part.begin_s == pytest.approx(ended - 1e-3)
    with pytest.raises(EmptyTimeline, match="the event log ends at"):
        collect.story_of(read_back, Range(since_wall_s=ended + 60))


@pytest.mark.e2e
def test_a_lease_from_before_the_range_keeps_its_bytes(switched: ArbiterProcess) -> None:
    """Its grant is in earlier pages; nothing else of that time is drawn."""
    with Client("asks", endpoint=switched.endpoint) as client:
        now = client.history(0, 2000).events[-1]["at_wall_s"]
    story = collect.from_history(Range(since_wall_s=now + 1e-4), switched.endpoint)
    assert lease_states(story) == {"encoder": ["held"], "grab": ["loading"]}
    bytes_by_name = story.bytes_by_name(story.gpus[0])
    assert {name: points[0][1] for name, points in bytes_by_name.items()} == {
        "encoder": GIB // 2, "grab": 6 * GIB
    }  # fmt: skip
    assert not story.evictions


def made_event(at_s: float, kind: str, consumer: str = "a", **more: object) -> dict[str, Any]:
    about = {"lease_id": f"L-{consumer}", "consumer": consumer, "gpu": "G"}
    return {"at_wall_s": at_s, "kind": kind, **about, **more}


def read_back(*events: Mapping[str, Any], end_s: float = 100.0) -> Story:
    reader = Reader(0.0)
    reader.gpu("G", "GPU 0", 8 * GIB, 0)
    for one in events:
        reader.event(one)
    return reader.story(end_s)


def test_standby_loss_and_pressure() -> None:
    story = read_back(
        made_event(1, "granted", charge_bytes=4),
        made_event(2, "ready", charge_bytes=3),
        made_event(5, "revoke_asked", wanted_by="b"),
        made_event(6, "released", was="revoking"),
        made_event(7, "verified", resolved=False, verdict="late"),
        made_event(8, "verified", resolved=True, verdict="verified"),
        made_event(8, "standby"),
        made_event(10, "granted", charge_bytes=4),
        made_event(11, "lost", reason="process died"),
        made_event(12, "verified", resolved=True, verdict="verified"),
        made_event(20, "released", "old", was="held"),
        made_event(21, "denied", "never"),
        {"at_wall_s": 30, "kind": "pressure", "gpu": "G", "pressure_bytes": 7},
        {"at_wall_s": 31, "kind": "pressure", "gpu": "G", "pressure_bytes": 0},
        {"at_wall_s": 40, "kind": "a_kind_of_tomorrow", "gpu": "G"},
    )
    assert lease_states(story) == {
        "a": ["loading", "held", "revoke", "verify", "standby", "loading", "verify"],
        "old": ["held", "verify"],
        "never": ["queued"],
    }
    lease = story.leases[0]
    assert lease.charges == [(1, 4), (2, 3), (8, 0), (10, 4), (12, 0)]
    (eviction,) = story.evictions
    assert (eviction.asked_s, eviction.end_s, eviction.verdict) == (5, 8, "verified")
    assert [(span.begin_s, span.end_s) for span in story.gpus[0].pressure] == [(30, 31)]
    assert [mark.kind for mark in story.marks] == ["lost", "denied"]
    part = within(story, 4.5, 9.0)
    assert [span.name for span in part.leases[0].states] == ["held", "revoke", "verify", "standby"]
    assert part.leases[0].charges == [(4.5, 3), (8, 0)]


def test_a_withdrawn_revoke_and_a_second_one() -> None:
    """The holder stays; an acknowledgement that is repeated while it unloads changes nothing."""
    story = read_back(
        made_event(1, "granted", charge_bytes=4),
        made_event(2, "ready", charge_bytes=3),
        made_event(3, "revoke_asked", wanted_by="b"),
        made_event(4, "revoke_withdrawn"),
        made_event(5, "revoke_asked", wanted_by="c"),
        made_event(6, "revoke_acked"),
        made_event(7, "unloading"),
        made_event(8, "revoke_acked"),
        end_s=9.0,
    )
    assert lease_states(story)["a"] == [
        "loading", "held", "revoke", "held", "revoke", "quiesce", "unload"
    ]  # fmt: skip
    first, second = story.evictions
    assert (first.verdict, first.end_s) == ("withdrawn", 4)
    assert (second.wanted_by, second.verdict, second.end_s) == ("c", "", None)


# -- forms
def rules_of_trace(printed: Mapping[str, Any]) -> list[str]:
    """Check the Trace Event Format's rules. Returns what breaks them."""
    broken: list[str] = []
    slices: dict[tuple[int, int], list[tuple[float, float]]] = {}
    started: dict[tuple[str, object, str], int] = {}
    named = {one["pid"] for one in printed["traceEvents"] if one["name"] == "process_name"}
    for one in printed["traceEvents"]:
        missing = {"ph", "name", "ts", "pid", "tid"} - one.keys()
        numbers = all(isinstance(one.get(key), int) for key in ("ts", "pid", "tid"))
        if missing or not numbers or one["ts"] < 0 or one["pid"] not in named:
            broken.append(f"fields: {one}")
        match one["ph"]:
            case "X":
                slices.setdefault((one["pid"], one["tid"]), []).append((one["ts"], one["dur"]))
            case "C":
                values = one["args"].values()
                if not values or not all(isinstance(value, int | float) for value in values):
                    broken.append(f"counter: {one}")
            case "b" | "e":
                key = (one["cat"], one["id"], one["name"])
                started[key] = started.get(key, 0) + (1 if one["ph"] == "b" else -1)
                if started[key] not in (0, 1):
                    broken.append(f"ends before it begins: {one}")
            case "i":
                if one["s"] not in ("g", "p", "t"):
                    broken.append(f"scope: {one}")
            case "M":
                if one["name"] not in ("process_name", "thread_name"):
                    broken.append(f"metadata: {one}")
            case _:
                broken.append(f"phase: {one}")
    broken += [f"has no end: {key}" for key, count in started.items() if count]
    for thread, found in slices.items():  # slices of a thread nest
        open_ends: list[float] = []
        for begin, length in sorted(found, key=lambda one: (one[0], -one[1])):
            while open_ends and open_ends[-1] <= begin:
                open_ends.pop()
            if length < 0 or (open_ends and begin + length > open_ends[-1]):
                broken.append(f"slices of {thread} overlap at {begin}")
            open_ends.append(begin + length)
    return broken


def hostile() -> Story:
    return read_back(
        made_event(1, "queued", HOSTILE, reason=HOSTILE),
        made_event(2, "granted", HOSTILE, charge_bytes=5 * GIB),
        made_event(3, "ready", HOSTILE, charge_bytes=5 * GIB),
        made_event(4, "use_began", HOSTILE, use_id="1", label=HOSTILE),
        made_event(5, "use_began", HOSTILE, use_id="2", label=HOSTILE),
        made_event(6, "revoke_asked", HOSTILE, wanted_by=HOSTILE, reason=HOSTILE),
        made_event(7, "revoke_acked", HOSTILE),
        made_event(8, "use_ended", HOSTILE, use_id="1", label=HOSTILE, ms=4e3),
        made_event(9, "oom", HOSTILE, reason=HOSTILE),
        made_event(20, "stowaway", HOSTILE, name=HOSTILE),
    )


@pytest.mark.e2e
def test_the_json_keeps_the_trace_formats_rules(printed: Story, tmp_path: Path) -> None:
    for story in (printed, hostile(), read_back()):
        write(tmp_path / "t.json", story)
        found = json.loads((tmp_path / "t.json").read_text())
        assert rules_of_trace(found) == []
    events = trace(printed)["traceEvents"]
    assert [one["name"] for one in events if one["ph"] == "X" and one["cat"] in PHASES] == PHASES
    counters = [one["args"] for one in events if one["ph"] == "C" and "grab" in one["args"]]
    assert counters[-1] == {"encoder": GIB // 2, "detector": 0, "grab": 6 * GIB}
    assert [one["cat"] for one in events if one["ph"] == "b"] == ["use", "queued"]
    broken = [{**one, "dur": 10**9} if one["name"] == "verify" else one for one in events]
    assert rules_of_trace({"traceEvents": broken}), "the check can fail"


@pytest.mark.e2e
def test_the_lines_show_each_consumer_from_left_to_right(printed: Story) -> None:
    """Bytes of the GPU, then one line for each consumer, in the order of their first lease."""
    shown = chart.lines(printed)
    assert shown[1].startswith("GPU 0 Simulated GPU")
    assert shown[1].endswith("of 8 GiB")
    by_name = {line[: chart.NAME_CHARS].strip(): line[chart.NAME_CHARS + 2 :] for line in shown}
    assert re.fullmatch(" *▒?█+", by_name["encoder"])
    assert re.fullmatch(" *▒?█*▼+", by_name["detector"])
    assert re.fullmatch(" *·*▒+", by_name["grab"])
    assert len(by_name["encoder"]) == chart.CELLS, "it is held to the end"
    for story in (hostile(), read_back()):
        assert all(line.isprintable() for line in chart.lines(story))


@pytest.mark.heavy
@pytest.mark.e2e
def test_the_png_is_drawn(printed: Story, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the runner extra")
    for number, story in enumerate((printed, hostile(), read_back())):
        path = tmp_path / f"{number}.png"
        write(path, story)
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 5000


@pytest.mark.heavy
def test_out_of_memory_is_marked_on_its_own_gpu(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each GPU showed those of all."""
    axes = pytest.importorskip("matplotlib.axes", reason="needs the runner extra").Axes
    marked: list[tuple[float, float]] = []
    real = axes.plot

    def plot(self: Any, xs: list[float], ys: list[float], *rest: Any, **named: Any) -> Any:
        marked.extend(zip(xs, ys, strict=True))
        return real(self, xs, ys, *rest, **named)

    monkeypatch.setattr(axes, "plot", plot)
    gpus = GpuStory("GPU-1", "one", 8 * GIB), GpuStory("GPU-2", "two", 16 * GIB)
    marks = Mark(5.0, "oom", "", "GPU-2"), Mark(6.0, "stopped", "", "GPU-2")
    write(tmp_path / "a.png", Story(0.0, 10.0, gpus, (), (), marks))
    assert marked == [(5.0, 16.0)]


# -- the command
@pytest.mark.e2e
def test_the_command_writes_what_its_ending_says(switched: ArbiterProcess, tmp_path: Path) -> None:
    environ, log = switched.environ, str(switched.state)
    made = vramctl("timeline", "-o", f"{tmp_path}/a.json", "--last", "1h", environ=environ)
    assert made.returncode == 0, made.stderr
    assert made.stdout.endswith("3 leases, 1 eviction\n")
    assert json.loads((tmp_path / "a.json").read_text())["traceEvents"]
    lines = vramctl("timeline", "--last", "1h", environ=environ)
    assert (lines.returncode, lines.stdout.count("\n")) == (0, 6), lines.stderr
    offline = ("timeline", "-o", f"{tmp_path}/b.json", "--event-log", log)
    assert vramctl(*offline, environ=environ).returncode == 0
    assert json.loads((tmp_path / "b.json").read_text())["traceEvents"]
    for arguments, code, says in (
        (("-o", "a.gif"), 2, "ends in .png, .json"),
        (("-o", "a.json", "--last", "soon"), 2, "expected 90s, 10m, 2h or 1d"),
        (("-o", "a.json", "--last", "1h", "--since", "1h"), 2, "not allowed with"),
        (("-o", f"{tmp_path}/no/a.json"), 2, "cannot be written: No such file"),
        (("-o", "a.json", "--event-log", f"{tmp_path}"), 1, "no event log here"),
        (("-o", "a.json", "--endpoint", f"ipc://{tmp_path}/s"), 3, "the socket does not exist"),
    ):
        done = vramctl("timeline", *arguments, environ=environ)
        assert done.returncode == code, done.stderr
        assert says in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.e2e
def test_a_damaged_or_empty_log_is_named(switched: ArbiterProcess, tmp_path: Path) -> None:
    (whole,) = (switched.state / "record").glob("*.jsonl")
    lines = whole.read_bytes().splitlines(keepends=True)
    log = tmp_path / "log.jsonl"
    for content, error, says in (
        (b"".join([*lines[:3], b"\0\n", *lines[3:]]), BadEventLog, "log.jsonl:4"),
        (lines[0], EmptyTimeline, "holds no events"),
    ):
        log.write_bytes(content)
        with pytest.raises(error, match=says):
            collect.from_log(log, Range())


@pytest.mark.e2e
def test_an_idle_daemon_has_nothing_to_draw(arbiter_daemon: ArbiterProcess) -> None:
    with Client("asks", endpoint=arbiter_daemon.endpoint) as client:
        now = client.history(0, 2000).events[-1]["at_wall_s"]
    with pytest.raises(EmptyTimeline, match="nothing happened since"):
        collect.from_history(Range(since_wall_s=now + 1e-4), arbiter_daemon.endpoint)


def test_a_missing_matplotlib_names_the_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from vram_arbiter.schemas.errors import ConfigError

    found: Callable[[str], object] = importlib.util.find_spec
    hidden = {"matplotlib"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in hidden else found(name)
    )
    with pytest.raises(ConfigError, match=re.escape("pip install 'vram-arbiter[runner]'")):
        write(tmp_path / "a.png", read_back())
