"""`vram-runner benchmark --env`: lerobot-eval under a lease, its results and its end."""

import argparse
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.cli import lerobot_eval
from vram_arbiter.runner.cli.benchmark import add_parser
from vram_arbiter.runner.cli.lerobot_eval import cells_of, checkpoint_of, flags_of, lease_of
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype


def report(out: Path) -> Any:
    return json.loads((out / "benchmark.json").read_text(encoding="utf-8"))


def grab_of(folder: Path, weights: str) -> Path:
    """Write the shipped grab's manifest with other weights."""
    grab = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    manifest = folder / "rskill.yaml"
    manifest.write_text(grab.replace("local://models/so101-grab", weights), encoding="utf-8")
    return manifest


@pytest.fixture
def pinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of `hf://lab/point@v1` in an offline cache of the hub, still empty."""
    constants = pytest.importorskip("huggingface_hub.constants")
    cached, commit = tmp_path / "hub/models--lab--point", "0123456789" * 4
    folder = cached / "snapshots" / commit
    folder.mkdir(parents=True)
    (cached / "refs").mkdir()
    (cached / "refs/v1").write_text(commit, encoding="utf-8")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    return folder


def test_a_pinned_checkpoint_is_played_from_its_own_folder(tmp_path: Path, pinned: Path) -> None:
    """Regression: lerobot-eval was given the revision as a flag, and read configuration and
    processors of the newest one.
    """
    (pinned / "config.json").write_text("{}", encoding="utf-8")
    played = load_manifest(grab_of(tmp_path, "hf://lab/point@v1"))
    assert Path(checkpoint_of(played)) == pinned
    newest = load_manifest(grab_of(tmp_path, "hf://lab/point"))
    assert checkpoint_of(newest) == "lab/point"


@pytest.mark.heavy
@pytest.mark.nightly  # its program imports torch and lerobot once more
@pytest.mark.timeout(600)
def test_lerobot_eval_plays_a_checkpoint_in_an_environment_of_lerobot(
    tmp_path: Path, pinned: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """lerobot's own program, with an environment and a small policy that it knows by a plugin."""
    pytest.importorskip("lerobot.policies", reason="needs the sidecars extra")
    make_point_policy(pinned)
    manifest = grab_of(tmp_path, "hf://lab/point@v1")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}/src:{ROOT}")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # lerobot leaves a file there
    argv = [
        *("benchmark", "--env", "point", "--skill", "vram-arbiter/so101-grab", "--no-arbiter"),
        *("--skills", str(manifest), "--episodes", "2", "--out", str(tmp_path / "out"), "--"),
        *("--env.discover_packages_path=tests.runner.point_world", "--policy.device=cpu"),
        *("--eval.batch_size=1", "--eval.use_async_envs=false"),
    ]
    code = main(argv)
    out, said = capfd.readouterr()
    assert code == 0, said[-3000:]
    (cell,) = report(tmp_path / "out")["cells"]
    assert (cell["world"], cell["judged"], cell["complete"]) == ("point", 2, True)
    assert "/2 = " in out


def make_point_policy(folder: Path) -> None:
    """Save an untrained policy of two joints and no cameras."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    two = (2,)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, two),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, two),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, two)},
        device="cpu", dim_model=32, n_heads=2, dim_feedforward=32, n_encoder_layers=1,
        use_vae=False, chunk_size=4, n_action_steps=4, pretrained_backbone_weights=None,
    )  # fmt: skip
    ACTPolicy(config).save_pretrained(folder)
    before, after = make_pre_post_processors(config, dataset_stats={})
    before.save_pretrained(folder)
    after.save_pretrained(folder)


def lerobot_args(*more: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser = add_parser(parser.add_subparsers())
    return parser.parse_args(["--env", "libero", "--seed", "7", *more])


def test_lerobot_eval_runs_under_a_lease_of_the_unquantized_bytes(tmp_path: Path) -> None:
    """Regression: the lease had the bytes of the quantized weights; lerobot-eval loads the
    checkpoint as it is.
    """
    libero = load_manifest(ROOT / "configs/rskills/libero-pi05-nf4/rskill.yaml")
    args = lerobot_args("--", "--env.task=libero_10")
    flags = flags_of("lerobot/pi05", args, tmp_path / "out")
    assert flags[0] == "--policy.path=lerobot/pi05"
    assert {"--env.type=libero", "--seed=7", "--env.task=libero_10"} <= set(flags)
    sizes = {Dtype.INT4: 4.0, Dtype.BF16: 9.0, Dtype.FP32: 17.5}
    lease = lease_of(libero.model_copy(update={"min_vram_gb": sizes}), args)
    assert lease[-5:-3] == ["--vram", "17.5GB"]
    assert lease[-1] == "--"
    assert os.path.exists(lease[0])
    with pytest.raises(ConfigError, match="does not declare min_vram_gb of fp32, fp16 or bf16"):
        lease_of(libero.model_copy(update={"min_vram_gb": {Dtype.INT4: 4.0}}), args)


def test_each_task_of_lerobots_environment_is_a_cell_with_the_same_seeds(tmp_path: Path) -> None:
    """Regression: the seeds were counted on through all tasks, whose rates were one."""
    libero = load_manifest(ROOT / "configs/rskills/libero-pi05-nf4/rskill.yaml")
    told = [
        {"task_group": "libero_10", "task_id": n, "metrics": {"successes": [True, n == 1]}}
        for n in range(2)
    ]
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": told}), encoding="utf-8")
    cells = cells_of(libero, lerobot_args(), tmp_path, 0)
    played = [(c.task, c.complete, [(e.seed, e.success) for e in c.episodes]) for c in cells]
    assert played == [
        ("libero_10/0", True, [(7, True), (8, False)]),
        ("libero_10/1", True, [(7, True), (8, True)]),
    ]
    (cell,) = cells_of(libero, lerobot_args(), tmp_path / "none", 1)
    assert (cell.complete, cell.why) == (False, "lerobot-eval ended with 1")


def eval_stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> list[str]:
    """Put a program in the place of lerobot-eval; return the command that starts it by main()."""
    program = folder / "lerobot-eval"
    program.write_text(f"#!{sys.executable}\n{code}\n", encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setattr(lerobot_eval.shutil, "which", lambda name, path: str(program))
    manifest = grab_of(folder, "local://models/so101-grab")
    return [
        *("benchmark", "--env", "point", "--skill", "vram-arbiter/so101-grab", "--no-arbiter"),
        *("--skills", str(manifest), "--out", str(folder / "out")),
    ]


def test_the_result_of_an_earlier_run_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a run that ended without a result had the rates of the one before."""
    argv = eval_stand_in(tmp_path, monkeypatch, "")
    earlier = tmp_path / "out/point_vram-arbiter-so101-grab/eval_info.json"
    earlier.parent.mkdir(parents=True)
    told = {"task_group": "point", "task_id": 0, "metrics": {"successes": [True]}}
    earlier.write_text(json.dumps({"per_task": [told]}), encoding="utf-8")
    assert main(argv) == 1
    (cell,) = report(tmp_path / "out")["cells"]
    assert (cell["played"], cell["complete"]) == (0, False)


def test_a_signal_ends_lerobot_eval_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: lerobot-eval went on, with its GPU memory, when the runner was told to end."""
    argv = eval_stand_in(
        tmp_path,
        monkeypatch,
        "import os, signal, time; os.kill(os.getppid(), signal.SIGTERM); time.sleep(600)",
    )
    assert main(argv) == 1
    (cell,) = report(tmp_path / "out")["cells"]
    assert cell["why"] == f"lerobot-eval ended with {-signal.SIGTERM}"
