"""`python -m vram_arbiter.runner sim` as a process: ready means ready, signals end it in order,
mistakes are said.
"""

import argparse
import contextlib
import fcntl
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from tests.support.waiting import play
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.runner import RunnerClient, RunnerUnreachable
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.__main__ import main, parse
from vram_arbiter.runner.cli.common import add_skill_flags, sidecars_given, start_sidecars
from vram_arbiter.runner.goals.catalogue import sidecar_endpoint
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.goals import PingRunner

pytestmark = pytest.mark.anyio


@pytest.fixture
def start_runner(tmp_path: Path, programs: list[Forked]) -> Callable[..., Forked]:
    def begin(*flags: str) -> Forked:
        environ = os.environ | {"VRAM_ARBITER_RUNTIME": str(tmp_path), "OMP_NUM_THREADS": "1"}
        argv = ["sim", "--skills", str(ROOT / "configs/rskills/so101-navigate"), *flags]
        programs.append(start("vram-runner", argv, environ, cwd=ROOT))
        return programs[-1]

    return begin


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_signal_ends_it_in_order_and_the_video_is_whole(
    start_runner: Callable[..., Forked], tmp_path: Path
) -> None:
    """SIGTERM is that of test_deploy.py."""
    import imageio_ffmpeg

    video = tmp_path / "episode.mp4"
    process = start_runner("--no-arbiter", "--seed", "2", "--video", str(video), "--rate", "30")

    async def use() -> None:
        async with RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=60.0) as client:
            assert (await client.call(PingRunner()))["pid"] == process.pid
            frame = await client.frame(encoding="png", max_age_ms=60_000.0)
            assert frame["data"].startswith(b"\x89PNG")
            truth = await client.ground_truth()
            assert truth["target"] in truth["objects"]
            assert truth["held"] is None
            # it never gets there
            far = {"header": {"frame_id": "map"}, "pose": {"position": {"x": -50.0, "y": 0.0}}}
            goal = await client.send_goal("vram-arbiter/so101-navigate", goal_params={"pose": far})
            async for feedback in goal.feedback():
                if feedback["tick_idx"] > 5:
                    break
            process.send_signal(signal.SIGINT)
            assert (await goal.result(60))["status"] == "canceled"

    play(use, 200.0)
    assert process.wait(60) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(video))[0] > 0


@pytest.mark.heavy
@pytest.mark.e2e
def test_without_an_arbiter_it_says_so_and_does_not_start(
    start_runner: Callable[..., Forked],
) -> None:
    process = start_runner()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "--no-arbiter" in errors
    assert "Traceback" not in errors


def test_wrong_flags_are_usage_errors(capsys: pytest.CaptureFixture[str]) -> None:
    for flags in (
        ["sim", "--rate", "-1"],
        ["sim", "--trace-ticks", "2"],
        ["sim", "--sed", "1"],
        [],
    ):
        with pytest.raises(SystemExit) as ended:
            parse(flags)
        assert ended.value.code == 2
    assert "usage" in capsys.readouterr().err


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--scene", "none.yaml"], "none.yaml"),
        (["--skills", "none"], "none"),
        (["--sidecar", "grab"], "grab: cannot be read"),
        (["--sidecar", "ipc:///x"], "RSKILL=ENDPOINT"),
        (["--sidecar", "=ipc:///x"], "RSKILL=ENDPOINT"),
        (
            ["--sidecar", "vram-arbiter/so101-grap=ipc:///x"],
            "no such policy or detector is installed: vram-arbiter/so101-grap",
        ),
        (["--skills", "/nonexistent"], "cannot be read"),
    ],
)
def test_wrong_files_are_named(
    capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    """Regression: `--sidecar` for a skill that is not installed was ignored."""
    assert main(["sim", "--no-arbiter", *flags]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.heavy
def test_a_second_runner_records_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It played, and left what it had played in the dataset, until it found out."""
    with open(tmp_path / "runner.sock.lock", "w") as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        there = ["--endpoint", f"ipc://{tmp_path}/runner.sock", "--record", str(tmp_path / "set")]
        assert main(["sim", *there, "--no-arbiter"]) == 1
    assert "already uses" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    "command",
    [
        ["sim"],
        ["deploy", "--config", "robot.yaml"],
        ["deploy", "--dry-run", "--config", "robot.yaml"],
    ],
)
def test_a_runner_serves_no_tcp_and_says_so_before_a_robot_has_power(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
) -> None:
    """Regression: over loopback TCP another user of the machine could command the robot."""
    (tmp_path / "robot.yaml").write_text(
        "robot_id: bench\nhal: {adapter: so101_mujoco}\nsensors: []\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--no-arbiter", "--endpoint", "tcp://127.0.0.1:7777"]) == 2
    said = capsys.readouterr().err
    assert "any user of the machine could connect" in said
    assert "write ipc://PATH" in said


def test_an_address_that_is_none_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Of all programs the one that stops motors ended with a traceback."""
    assert main(["estop", "--endpoint", "runner.sock"]) == 2
    assert "'runner.sock' is not an endpoint" in capsys.readouterr().err


def test_where_a_sidecar_is() -> None:
    environ = {"VRAM_ARBITER_RUNTIME": "/run/x"}
    assert sidecar_endpoint("vram-arbiter/so101-grab", {}, environ) == "ipc:///run/x/grab.sock"
    assert sidecar_endpoint("a/grab", {}, environ) == "ipc:///run/x/grab.sock"
    given = sidecars_given(["a/grab=tcp://127.0.0.1:7"])
    assert sidecar_endpoint("a/grab", given, environ) == "tcp://127.0.0.1:7"
    with pytest.raises(ConfigError):
        sidecars_given(["=x"])


async def test_a_runner_that_is_not_there_is_unreachable(tmp_path: Path) -> None:
    async with RunnerClient(f"ipc://{tmp_path}/runner.sock", connect_timeout_s=0.2) as client:
        with pytest.raises(RunnerUnreachable):
            await client.skills()


@pytest.mark.heavy
@pytest.mark.e2e
async def test_a_sidecar_is_there_as_long_as_the_runner_that_starts_it(
    arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in arbiter_daemon.environ.items():
        monkeypatch.setenv(name, value)
    elsewhere = "lab/other=ipc:///run/other.sock"
    flags = argparse.ArgumentParser()
    add_skill_flags(flags)
    args = flags.parse_args(["--sidecar", "so101-grab", "--sidecar", elsewhere])
    endpoint = sidecars_given(args.sidecar)["vram-arbiter/so101-grab"]
    async with contextlib.AsyncExitStack() as stack:
        await start_sidecars(args, stack)
        async with PolicyClient(endpoint) as client:
            assert (await client.ping())["rskill"] == "vram-arbiter/so101-grab"
    assert not is_listening(endpoint)
