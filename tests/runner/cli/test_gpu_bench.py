"""The shipped deployment with everything on, played from a file instead of a camera.

Real programs (arbiter, detector, diagnostic skill, runner with its recorder) on a simulated GPU,
which export by OTLP to a collector in the test. The film is H.264, encoded here by libx264.
"""

import asyncio
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

pytest.importorskip("gi", reason="the extra `gstreamer`")
pytest.importorskip("opentelemetry.sdk", reason="the extra `telemetry`")

from tests.support import prepared
from tests.support.collector import Collector
from tests.support.paths import CONFIGS
from tests.support.process import ArbiterProcess
from tests.support.programs import Programs
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.sensors.pipelines import GStreamerParams, build
from vram_arbiter.runner.sensors.platform import Platform
from vram_arbiter.schemas.goals import ResultPush
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

# each part has tests of its own: cameras of files, detectors, recorder, spans, the skill
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.heavy,
    pytest.mark.e2e,
    pytest.mark.timeout(300),
    pytest.mark.usefixtures("forked_writers"),
]

BENCH = CONFIGS / "robots/gpu-bench.yaml"
DETECTOR = CONFIGS / "rskills/so101-detector/rskill.yaml"
PASSTHROUGH = CONFIGS / "diagnostics/gpu-passthrough/rskill.yaml"
SKILL = "vram-arbiter/gpu-passthrough"
WAIT_S = 200.0
FPS = 30


class Film(NamedTuple):
    """A file, what it shows, and the means of its pictures by channel, 0 to 1."""

    path: Path
    shows: str
    means: list[float]


@pytest.fixture
def film(tmp_path: Path) -> Film:
    """A second of the simulator's front camera, which sees an object."""
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("mujoco")
    from vram_arbiter.runner.sim.env import SimEnv

    path = tmp_path / "front.mp4"
    with SimEnv() as env:
        env.reset(900)
        picture, shows = env.render("front"), env.target
    with imageio.get_writer(path, fps=FPS, codec="libx264", macro_block_size=1) as writer:
        for _ in range(FPS):
            writer.append_data(picture)
    return Film(path, shows, (picture.mean(axis=(0, 1)) / 255).tolist())


def played_from(film: Path, root: Path) -> str:
    """Return the shipped file with a film as its camera, which records into `root`."""
    robot = yaml.safe_load(BENCH.read_text(encoding="utf-8"))
    (camera,), (detector,) = robot["sensors"], robot["detectors"]
    camera_params = GStreamerParams.model_validate(camera["backend_params"])
    assert " nvh264dec " in build(camera_params, Platform.NVIDIA_DESKTOP)
    assert " avdec_h264 " in build(camera_params, Platform.CPU_ONLY)
    camera["backend_params"] = {"source": "file", "path": str(film), "loop": True}
    camera["backend_params"]["platform"] = "cpu_only"  # the GPU of this test has no decoder
    camera["max_age_ms"], detector["max_age_ms"] = 2000, 20_000  # on a busy machine
    robot["save_dir"] = str(root)
    return yaml.safe_dump(robot)


def test_everything_on(arbiter_daemon: ArbiterProcess, film: Film, tmp_path: Path) -> None:
    root, config = tmp_path / "set", tmp_path / "bench.yaml"
    config.write_text(played_from(film.path, root), encoding="utf-8")
    with ExitStack() as stack:
        collector = stack.enter_context(Collector())
        programs = Programs(arbiter_daemon, collector.environ() | {"OMP_NUM_THREADS": "1"})
        stack.callback(programs.close)
        for name, manifest in (("detector", DETECTOR), ("passthrough", PASSTHROUGH)):
            words = ("--name", name, "--rskill", str(manifest))
            programs.start("vram-sidecar", *words, "--device", f"fake:{arbiter_daemon.gpu_folder}")
        skills = ("--skills", str(DETECTOR), str(PASSTHROUGH))
        programs.start("vram-runner", "deploy", "--config", str(config), *skills)
        try:
            collector.wait(lambda: looked(collector), "look of the detector", WAIT_S)
            result = asyncio.run(asyncio.wait_for(one_goal(arbiter_daemon, film.shows), WAIT_S))
            assert programs.end() == [0, 0, 0]
        except BaseException:
            print(programs.log.read_text(errors="replace")[-6000:])
            raise
        check_goal(result, film)
        check_telemetry(collector, result)
        check_recording(root, arbiter_daemon, film)


def looked(collector: Collector) -> bool:
    """Return whether a look was told that did not fail."""
    looks = [point.attributes for point in collector.points(telemetry.METRIC_LOOKS)]
    return {telemetry.ATTR_SENSOR: "front"} in looks


async def one_goal(daemon: ArbiterProcess, shown: str) -> ResultPush:
    """Play one once the world state says what the film shows, under both leases."""
    async with (
        RunnerClient(f"ipc://{daemon.runtime}/runner.sock", connect_timeout_s=WAIT_S) as runner,
        AsyncClient("watcher", endpoint=daemon.endpoint, role="observer") as watcher,
    ):
        seen: set[tuple[str, str]] = set()
        while (shown, "front") not in seen:
            world = (await runner.state())["world"] or {}
            seen = {(one["label"], one["sensor_id"]) for one in world.get("detected_objects", ())}
        goal = await runner.send_goal(SKILL, prompt="look", deadline_s=WAIT_S)
        held: dict[str, str] = {}
        async for feedback in goal.feedback():
            if feedback["state"] == "running" and not held:
                held = {lease.consumer: lease.state for lease in (await watcher.status()).leases}
        assert held == {"detector": "held", "passthrough": "held"}
        return await goal.result(WAIT_S)


def check_goal(result: ResultPush, film: Film) -> None:
    """What the GPU computed of the decoded film came back as the actions' confidence."""
    assert result["status"] == "succeeded", result
    data = result["data"]
    assert (data["steps"], data["withheld"]) == (60, 0)
    assert data["confidence"] == pytest.approx(sum(film.means) / 3, abs=0.02)


def check_telemetry(collector: Collector, result: ResultPush) -> None:
    ticks = collector.spans(telemetry.SPAN_TICK)
    told = [span.attributes.get(telemetry.ATTR_CONFIDENCE) for span in ticks]
    assert result["data"]["confidence"] in told
    (goal,) = collector.spans(telemetry.SPAN_GOAL)
    assert {span.trace_id for span in ticks} == {goal.trace_id}
    asked = collector.spans(telemetry.SPAN_SIDECAR_REQUEST)
    assert {span.service for span in asked} == {"vram-sidecar-detector", "vram-sidecar-passthrough"}


def check_recording(root: Path, daemon: ArbiterProcess, film: Film) -> None:
    done = prepared.run("dataset-reader", [str(root)], daemon.environ, WAIT_S)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert (found["episodes"], found["task"]) == (1, "look")
    assert found["frames"] >= 60
    assert found["moved"] == pytest.approx(0, abs=0.03)
    (means,) = found["cameras"].values()
    assert means == pytest.approx(film.means, abs=0.05)  # encoded twice
