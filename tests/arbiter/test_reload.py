"""Configuration read again by a real daemon on SIGHUP: taken whole or refused, replayable."""

import json
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ArbiterProcess, vramctl
from tests.support.wire import WireClient
from vram_arbiter import Client
from vram_arbiter.arbiter import reload
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.reload import Source
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.settings import core_changes
from vram_arbiter.schemas.config.arbiter import LIVE_KEYS, ArbiterConfig, load_config
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.connection import Bounds

FIRST = "limits: {leases_per_client_max: 2}\nlog: {level: info}\n"


@pytest.fixture
def reloadable() -> Iterator[ArbiterProcess]:
    made = ArbiterProcess(config=FIRST, arguments=("--log-format", "json"), prepared=True)
    made.start()
    yield made
    made.close()


@pytest.fixture
def watcher(reloadable: ArbiterProcess) -> Iterator[WireClient]:
    made = WireClient(reloadable.endpoint).hello()
    yield made
    made.close()


def reloaded(reloadable: ArbiterProcess, text: str | None) -> None:
    """Write the file (None: remove it), send SIGHUP, wait until the daemon is ready again."""
    file = reloadable.runtime / "arbiter.yaml"
    if text is None:
        file.unlink()
    else:
        file.write_text(text)
    reloadable.process.send_signal(signal.SIGHUP)
    told = reloadable.wait_for("RELOADING=1", 60.0)
    assert int(told.partition("MONOTONIC_USEC=")[2]) > 0
    reloadable.wait_for("READY=1", 60.0)


def newest_event(watcher: WireClient) -> Mapping[str, Any]:
    """Return the newest event of the history about the configuration."""
    reply = watcher.ask("history", limit=1000, kinds=["config_reloaded", "config_refused"])
    newest: Mapping[str, Any] = reply["events"][-1]
    return newest


def room(reloadable: ArbiterProcess) -> int:
    """Return how many leases one client may have, as the engine decides it."""
    name = f"room-{time.monotonic_ns()}"
    one = WireClient(reloadable.endpoint).hello(instance=name)
    try:
        asked = [
            one.ask("acquire", nonce=f"{name}-{n}", spec=small_spec(f"{name}-{n}"))
            for n in range(6)
        ]
        one.ask("bye")
    finally:
        one.close()
    return sum("lease" in reply for reply in asked)


def small_spec(consumer: str) -> dict[str, Any]:
    sizes = {"load_peak_bytes": 1 << 20, "steady_bytes": 1 << 20, "residue_bytes": 0}
    return {"consumer": consumer, "model_id": consumer, "ttl_s": 600.0, "footprint": sizes}


def levels(reloadable: ArbiterProcess) -> set[str]:
    return {json.loads(line)["level"].lower() for line in reloadable.log.splitlines()}


BAD = {
    "YAML": ("limits: [\n", "arbiter.yaml:2: see"),
    "unknown key": ("revoke: {dedline_s: 3}\n", "arbiter.yaml:1: see"),
    "out of bounds": ("limits: {leases_per_client_max: 0}\n", "arbiter.yaml:1: see"),
    "one of two": (
        "limits: {leases_per_client_max: 5}\nverify: {timeout_s: -1}\n",
        "arbiter.yaml:2: see `vram-arbiter --check-config --config",
    ),
    "half of a write": ("limits: {leases_per_client_max: 5}\nlog:\n  lev", "arbiter.yaml:2"),
    "another file": ("root:$6$secret:19000:0:99999:7:::\n", "arbiter.yaml:1"),
    "truncated": ("", "is empty"),
    "gone": (None, "arbiter.yaml"),
}


@pytest.mark.e2e
def test_a_file_takes_effect_or_is_refused_whole_and_a_replay_knows(
    reloadable: ArbiterProcess, watcher: WireClient
) -> None:
    """Replayed with the constants of the start alone, the third lease would be refused."""
    assert room(reloadable) == 2
    reloaded(reloadable, "limits: {leases_per_client_max: 3}\nwire: {heartbeat_s: 7}\n")
    assert room(reloadable) == 3
    event = newest_event(watcher)
    assert event["changed"] == {"limits.leases_per_client_max": [2, 3]}
    assert event["needs_restart"] == {"wire.heartbeat_s": [2.0, 7.0]}
    pending = "changed keys need a restart: wire.heartbeat_s"
    assert watcher.ask("status")["problems"] == [pending]
    assert pending in reloadable.messages[-1], "what the reload itself tells the manager"
    doctor = vramctl("doctor", environ=reloadable.environ).stdout
    assert pending in doctor
    for name, (text, words) in BAD.items():
        reloaded(reloadable, text)
        problem, still = watcher.ask("status")["problems"]
        assert still == pending
        assert problem.startswith("the changed configuration is refused"), name
        assert words in problem, name
        assert "secret" not in str(newest_event(watcher)) + problem, "a link was quoted"
        event = newest_event(watcher)
        assert (event["kind"], event["problem"] in problem) == ("config_refused", True), name
        assert room(reloadable) == 3, f"{name}: the former configuration is in force"
    assert "the former one is in force" in vramctl("status", environ=reloadable.environ).stdout
    assert levels(reloadable) <= {"info", "warning"}
    reloaded(reloadable, "limits: {leases_per_client_max: 4}\nlog: {level: debug}\n")
    assert watcher.ask("status")["problems"] == []
    changed = {"limits.leases_per_client_max": [3, 4], "log.level": ["info", "debug"]}
    assert newest_event(watcher)["changed"] == changed
    assert room(reloadable) == 4
    with (
        Client("user", endpoint=reloadable.endpoint) as user,
        user.lease(vram="1MB", model="m") as lease,
        lease.use("look"),  # logged as a detail
    ):
        pass
    assert reloadable.stop() == 0
    assert "debug" in levels(reloadable)
    told = [json.loads(line) for line in reloadable.log.splitlines() if '"config_reloaded' in line]
    assert told[0]["event"]["needs_restart"] == {"wire.heartbeat_s": [2.0, 7.0]}
    done = vramctl("replay", str(reloadable.state), environ=reloadable.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    logs = "".join(path.read_text() for path in (reloadable.state / "record").iterdir())
    assert logs.count('"event":"SettingsChanged"') == 2


# -- the file while it is written
def source(path: Path, load: Callable[[Path | None], ArbiterConfig]) -> Source:
    return Source(lambda: path if path.exists() else None, load)


def test_a_file_that_is_still_written_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "arbiter.yaml"
    path.write_text("log: {level: debug}\n")

    def write_on(seconds: float) -> None:
        path.write_text(path.read_text() + "# more\n")

    monkeypatch.setattr(reload.time, "sleep", write_on)
    with pytest.raises(ConfigError, match="is still being written"):
        reload._read(source(path, lambda file: ArbiterConfig()), path)

    def load(file: Path | None) -> ArbiterConfig:
        write_on(0.0)
        return ArbiterConfig()

    monkeypatch.setattr(reload.time, "sleep", lambda seconds: None)
    with pytest.raises(ConfigError, match="changed while it was read"):
        reload._read(source(path, load), path)
    config = load_config("log: {level: debug}\n", "x")
    assert reload._read(source(path, lambda file: config), None) == (path, config)


def test_a_file_that_appears_is_read_and_one_that_goes_is_not_forgotten(tmp_path: Path) -> None:
    path, config = tmp_path / "arbiter.yaml", ArbiterConfig()
    given = source(path, lambda file: config)
    assert reload._read(given, None) == (None, config)
    with pytest.raises(ConfigError, match="is gone"):
        reload._read(given, path)


def test_each_live_key_reaches_a_part() -> None:
    """The others are the history's bounds and the log's level, which `Reload` sets itself."""
    names = {field.name for field in fields(Settings)}
    reached = {}
    for section, keys in LIVE_KEYS.items():
        for key in keys:
            (changed,) = core_changes(ArbiterConfig(), [f"{section}.{key}"]) or {"": 0}
            reached[f"{section}.{key}"] = changed
    assert {path for path, name in reached.items() if not name} == {
        "history.max_events", "history.days", "log.level",
    }  # fmt: skip
    assert set(reached.values()) <= names | {""}
    elsewhere = {field.name for cls in (SessionSettings, Bounds) for field in fields(cls)}
    assert not elsewhere & set(reached.values()), "a copy would keep the former value"


def test_only_live_keys_change_what_is_in_force() -> None:
    before = ArbiterConfig()
    after = load_config("revoke: {deadline_s: 9}\nwire: {heartbeat_s: 9}\n", "x")
    live, others = reload.changes(before, after)
    assert (live, others) == ({"revoke.deadline_s": (30.0, 9.0)}, {"wire.heartbeat_s": (2.0, 9.0)})
    assert reload.changes(before, reload.merged(before, after)) == (live, {})
