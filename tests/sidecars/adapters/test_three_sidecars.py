"""Detector, scene VLM and policy as real processes with real (tiny) checkpoints and the demo's
footprints, under a real daemon on 8 GiB."""

import subprocess
import sys
from pathlib import Path

import msgpack
import pytest

from tests.support.fakegpu_check import check_log
from tests.support.wire import WireClient
from vram_arbiter.clients.sidecar import npy

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(400)]

PATIENCE_S = 180.0
COMMON = (
    "version: 0.1.0\nlicense: mit\nembodiment_tags: [any]\nchunk_size: 5\n"
    "description: a tiny model\nlatency_budget: {per_chunk_ms: 100}\n"
)
SKILLS = {
    "detector": ("so101-detector", "owlvit",
    "kind: detector\nactions: [detect]\ndetector: {labels: [cube], score_threshold: 0.0}\n"),
    "scene-vlm": ("so101-scene-vlm", "qwen", "kind: vlm\nrole: s2\nactions: [query]\n"),
    "grab": (
        "so101-grab", "act",
        "kind: vla\nmodel_family: act\nactions: [grasp]\nactuators_required:\n"
        "  - {kind: joint_position, control_mode_semantics: {mode: absolute}}\n",
    ),
}  # fmt: skip


@pytest.fixture
def sidecars(arbiter_daemon, configs, weights, tmp_path):
    processes, clients = [], {}
    footprints = Path(__file__).parents[3] / "configs/models/footprints.yaml"
    for name, (skill, model, block) in SKILLS.items():
        weights(model)
        rskill = tmp_path / f"{name}.yaml"
        rskill.write_text(
            f"name: vram-arbiter/{skill}\nweights_uri: local://models/{model}\n{COMMON}{block}"
        )
        command = [
            sys.executable, "-m", "vram_arbiter.sidecars", "--name", name, "--rskill", str(rskill),
            "--configs", str(configs),
            "--footprints", str(footprints), "--device", f"fake:{arbiter_daemon.card}",
        ]  # fmt: skip
        environ = {**arbiter_daemon.environ, "OMP_NUM_THREADS": "1"}
        with (tmp_path / f"{name}.log").open("wb") as log:
            processes.append(subprocess.Popen(command, env=environ, stdout=log, stderr=log))
        clients[name] = WireClient(f"ipc://{arbiter_daemon.runtime}/{name}.sock")
    yield clients
    for client in clients.values():
        client.close()
    for process in processes:
        process.terminate()
    assert [process.wait(60) for process in processes] == [0, 0, 0]


def ask(client, message):
    client.send_raw(msgpack.packb(message | {"id": 1000}))
    reply = client.reply(1000, PATIENCE_S)
    assert reply.get("ok", True), reply  # actions come without it
    return reply


def test_the_budget_of_8_gib_is_shared_as_it_fits(sidecars, arbiter_daemon, png):
    numpy = pytest.importorskip("numpy")
    image = png(320, 240)
    observation = {
        "observation.images.front": numpy.zeros((64, 64, 3), numpy.uint8),
        "observation.state": numpy.zeros(6, numpy.float32),
        "task": "grab the red cube",
    }
    detect = {"op": "detect", "image": image, "query": "red cube"}
    query = {"op": "query", "image": image, "question": "is it held?", "max_new_tokens": 4}
    act = {
        "endpoint": "get_action",
        "data": npy.pack({"observation": observation, "options": None}),
    }

    def states():
        return {name: ask(client, {"op": "ping"})["state"] for name, client in sidecars.items()}

    ask(sidecars["detector"], detect)
    ask(sidecars["scene-vlm"], query)
    assert states() == {"detector": "parked", "scene-vlm": "resident", "grab": "unloaded"}
    answer = npy.unpack(ask(sidecars["grab"], act))
    assert answer["action"].shape == (5, 6)
    assert states() == {"detector": "parked", "scene-vlm": "resident", "grab": "resident"}, (
        "these two fit together"
    )
    ask(sidecars["scene-vlm"], query)
    ask(sidecars["detector"], detect)
    assert states() == {"detector": "resident", "scene-vlm": "parked", "grab": "parked"}
    report = check_log((arbiter_daemon.card / "log.jsonl").read_text())
    assert (report.problems, report.oom_events) == ([], 0)
    assert report.peak_bytes <= report.capacity_bytes
