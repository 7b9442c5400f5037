"""docs/how-to/train-a-policy.md from its first command to its last: a session recorded here is
trained on by lerobot's own program, and the checkpoint is served under a lease and benchmarked.

The page's commands with smaller numbers: it shows that each hand-over works, and no skill.
"""

import asyncio
import json
import re
import shlex
from pathlib import Path

import pytest

from tests.support.fakegpu_check import check_log
from tests.support.paths import ROOT
from tests.support.prepared import Forked, run, start, warm
from tests.support.process import ArbiterProcess, vramctl
from vram_arbiter.clients.sidecar.policy import PolicyClient

pytestmark = [
    pytest.mark.heavy, pytest.mark.e2e, pytest.mark.nightly, pytest.mark.timeout(600),
]  # fmt: skip

PAGE = ROOT / "docs/how-to/train-a-policy.md"
SCENE = """cameras:
  front: {parent: base, width_px: 64, height_px: 48, fovy_deg: 43.0,
          pos_m: [-0.08, 0.2, 0.6], look_at_m: [0.467, 0.053, 0.2]}
  wrist: {parent: gripper, width_px: 48, height_px: 32, fovy_deg: 62.0,
          pos_m: [0.015, -0.085, -0.03], look_at_m: [0.018, 0.0, -0.1], up: [1.0, 0.0, 0.0]}
"""
TINY = """--policy.pretrained_backbone_weights=null --policy.dim_model=32 --policy.n_heads=2
--policy.dim_feedforward=32 --policy.n_encoder_layers=1 --policy.use_vae=false --num_workers=0"""
SMALLER = {
    "--episodes 200": "--episodes 2 --scene small.yaml",
    "--policy.device=cuda": "--policy.device=cpu",
    "--batch_size=8 --steps=50000": f"--batch_size=2 --steps=2 {TINY}",
    "--episodes 50": "--episodes 1 --max-steps 24 --no-videos --scene small.yaml",
}
GB = 10**9
WAIT_S = 300.0


def blocks(language: str) -> list[str]:
    found = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return [block.replace("\\\n", " ").strip() for block in found]


def smaller(command: str) -> list[str]:
    for words, fewer in SMALLER.items():
        command = command.replace(words, fewer)
    return shlex.split(command)


def test_a_recorded_session_is_trained_on_served_and_benchmarked(
    arbiter_daemon: ArbiterProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record, _, train, check, serve, measure = blocks("sh")
    (manifest,) = blocks("yaml")
    for words in SMALLER:
        assert words in f"{record} {train} {measure}", "the page has other numbers"
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(SCENE)
    Path("act-grab").mkdir()
    Path("act-grab/rskill.yaml").write_text(manifest)
    environ = arbiter_daemon.environ | {
        "VRAM_FAKE_GPU": str(arbiter_daemon.gpu_folder),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path / "hub"),
    }

    def typed(command: str) -> None:
        program, *arguments = smaller(command)
        done = run(program, arguments, environ, WAIT_S)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]

    def sidecar(command: str) -> Forked:
        with Path("sidecar.log").open("ab") as log:
            arguments = smaller(command.removesuffix("&"))[1:]
            return start("vram-sidecar", arguments, environ, log.fileno(), log.fileno())

    warm("dataset-writer")
    typed(record)
    typed(train)
    learned = json.loads(Path("train/checkpoints/last/pretrained_model/config.json").read_text())
    assert [*learned["input_features"], *learned["output_features"]] == [
        "observation.state",
        "observation.images.front",
        "observation.images.wrist",
        "action",
    ]
    try:
        assert sidecar(check).wait(WAIT_S) == 0
        Path("other.yaml").write_text(manifest.replace("images.wrist", "images.palm"))
        other = sidecar(check.replace("act-grab/rskill.yaml", "other.yaml"))
        assert other.wait(WAIT_S) == 2, "its first goal would fail"
        misfit = "the checkpoint reads observation.images.wrist, sensors_required names "
        assert misfit in Path("sidecar.log").read_text()
        serving = sidecar(serve)
        try:
            asyncio.run(until_it_serves(f"ipc://{arbiter_daemon.runtime}/grab.sock"))
            typed(measure)
        finally:
            serving.terminate()
            serving.wait(WAIT_S)
    except BaseException:
        print(Path("sidecar.log").read_text(errors="replace")[-3000:])
        raise

    (cell,) = json.loads(Path("bench/benchmark.json").read_text())["cells"]
    assert (cell["contestant"], cell["task"], cell["complete"]) == ("lab/act-grab", "grab", True)
    assert (cell["played"], cell["judged"], cell["errors"]) == (1, 1, 0)
    assert cell["mean_steps"] > 0
    history = vramctl("history", "--all", "-c", "grab", environ=environ).stdout
    assert "use_began" in history, history
    used = check_log((arbiter_daemon.gpu_folder / "log.jsonl").read_text())
    assert (used.problems, used.peak_bytes >= 0.6 * GB) == ([], True)


async def until_it_serves(endpoint: str) -> None:
    async with PolicyClient(endpoint, connect_timeout_s=WAIT_S) as sidecar:
        assert (await sidecar.ping(timeout_s=WAIT_S))["rskill"] == "lab/act-grab"
