"""A skill's checkpoint in an environment of lerobot, by `lerobot-eval` under a lease.

lerobot makes the environment and plays the checkpoint in a process of its own: neither the sidecar
nor this runner's gate takes part.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import json
import os
import shutil
import sys
from pathlib import Path

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome
from vram_arbiter.runner.benchmark.report import MAX_STEPS, PAGE, REPORT, table, write_report
from vram_arbiter.runner.cli.common import default_skills, install_signals
from vram_arbiter.runner.goals.catalogue import read_manifests
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype
from vram_arbiter.schemas.runtime.printable import printable_lines

PROGRAM = "lerobot-eval"
RESULT = "eval_info.json"
OWN_ENVIRONMENT = (
    "it needs mujoco < 3.9, and the extra runner a newer one: install vram-arbiter[sidecars] and"
    " lerobot[{env}] in an environment of its own, and run this command there"
)
PACKAGES = {
    "pusht": ("gym_pusht", "pip install 'lerobot[pusht]'"),
    "aloha": ("gym_aloha", "pip install 'lerobot[aloha]'"),
    "libero": ("libero", OWN_ENVIRONMENT),
    "metaworld": ("metaworld", OWN_ENVIRONMENT),
}
"""Environments of lerobot that are packages apart: the module, and how it is installed."""
UNQUANTIZED = (Dtype.FP32, Dtype.FP16, Dtype.BF16)


async def evaluate(args: argparse.Namespace) -> int:
    """Play every `--skill` in the environment; write the report and print the table.

    Returns: 0 if every episode got a verdict, 1 otherwise. Raises ConfigError, UnknownSkill.
    """
    program = _checked(args)
    args.max_steps = None  # the environment has its own limit
    manifests = {one.name: one for one in read_manifests(args.skills or [default_skills()])}
    wanted = [_policy(manifests.get(name), name, args) for name in dict.fromkeys(args.skill)]
    leases = [[] if args.no_arbiter else lease_of(manifest, args) for manifest in wanted]
    check_output("--out", args.out / REPORT)
    paths = [await asyncio.to_thread(checkpoint_of, manifest) for manifest in wanted]
    stopping = asyncio.Event()
    install_signals(stopping)
    cells: list[Cell] = []
    complete = False
    for number, (manifest, lease, path) in enumerate(zip(wanted, leases, paths, strict=True), 1):
        if stopping.is_set():
            break
        out = args.out / f"{args.env}_{manifest.name.replace('/', '-')}"
        (out / RESULT).unlink(missing_ok=True)  # of an earlier run
        code = await _run([*lease, program, *flags_of(path, args, out)], stopping)
        cells += cells_of(manifest, args, out, code)
        complete = number == len(wanted) and all(cell.complete for cell in cells)
        write_report(args, cells, complete=complete)
    print(printable_lines(table(cells)))
    print(f"{args.out / REPORT}\n{args.out / PAGE}")
    return 0 if complete else 1


def _checked(args: argparse.Namespace) -> str:
    """Return the path of `lerobot-eval`. Raises ConfigError for flags that it does not have."""
    if args.policy or args.task or args.scene or args.record or not args.skill:
        raise ConfigError(
            f"--env {args.env} plays the checkpoints of skills: give --skill, and neither --policy,"
            " --task, --scene nor --record"
        )
    if args.workers > 1 or args.ray:
        raise ConfigError(
            f"--env {args.env} is played by one {PROGRAM}: give neither --workers nor --ray",
            hint="-- --eval.batch_size=10 plays ten episodes at the same time",
        )
    if args.max_steps != MAX_STEPS or args.latency_steps is not None or args.real_time:
        raise ConfigError(
            f"--env {args.env} has its own limit of steps and no latency: give neither --max-steps,"
            " --latency-steps nor --real-time"
        )
    program = shutil.which(PROGRAM, path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if program is None:
        raise ConfigError(
            f"--env {args.env} needs {PROGRAM}", hint="pip install 'vram-arbiter[sidecars]'"
        )
    module, how = PACKAGES.get(args.env, ("lerobot", ""))
    own = Path(program).parent == Path(sys.executable).parent  # else its packages are not known
    if own and importlib.util.find_spec(module) is None:
        raise ConfigError(
            f"--env {args.env} needs the package {module}", hint=how.format(env=args.env)
        )
    return program


def _policy(manifest: RSkillManifest | None, name: str, args: argparse.Namespace) -> RSkillManifest:
    if manifest is None or manifest.kind is not Kind.VLA or not manifest.weights_uri:
        raise ConfigError(f"--skill {name}: no policy of that name is installed")
    if why := manifest.license_refusal(allow_noncommercial=args.allow_noncommercial):
        raise ConfigError(f"--skill {name}: {why}")
    return manifest


def checkpoint_of(manifest: RSkillManifest) -> str:
    """Return the folder of the checkpoint, or its hub id where no revision is pinned. Blocks.

    lerobot-eval reads configuration and processors of the newest revision, whatever is pinned: a
    pinned one is downloaded here. Raises ConfigError.
    """
    where, _, place = (manifest.weights_uri or "").partition("://")
    path, _, revision = place.partition("@")
    if where == "local":
        return str(configs_folder(os.environ) / path)
    if not revision:
        return path
    from huggingface_hub import snapshot_download

    try:
        return str(snapshot_download(path, revision=revision))
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be fetched: {type(error).__name__}: {error}",
            hint="check its name, its revision and the network, or fetch it with `hf download`",
        ) from error


def flags_of(path: str, args: argparse.Namespace, out: Path) -> list[str]:
    """Return the arguments of `lerobot-eval` for the checkpoint at `path`."""
    return [
        f"--policy.path={path}",
        f"--env.type={args.env}",
        f"--eval.n_episodes={args.episodes}",
        f"--seed={args.seed}",
        f"--output_dir={out}",
        *args.lerobot_flags,
    ]


async def _run(command: list[str], stopping: asyncio.Event) -> int:
    """Return the program's exit code, after it was told to end when `stopping` is set."""
    process = await asyncio.create_subprocess_exec(*command)
    ended = asyncio.create_task(process.wait())
    stopped = asyncio.create_task(stopping.wait())
    await asyncio.wait([ended, stopped], return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
    if not ended.done():
        process.terminate()
    return await ended


def lease_of(manifest: RSkillManifest, args: argparse.Namespace) -> list[str]:
    """Return what runs a program under a lease of the bytes that the manifest declares.

    lerobot-eval loads the checkpoint unquantized.
    """
    declared_gb = [gb for dtype, gb in (manifest.min_vram_gb or {}).items() if dtype in UNQUANTIZED]
    if not declared_gb:
        raise ConfigError(
            f"{manifest.name} does not declare min_vram_gb of fp32, fp16 or bf16",
            hint="declare it, or run with --no-arbiter",
        )
    endpoint = ["--endpoint", args.arbiter] if args.arbiter else []
    run = [sys.executable, "-P", "-m", "vram_arbiter.clients", "run", *endpoint]
    return [*run, "--vram", f"{max(declared_gb):g}GB", "--name", PROGRAM, "--"]


def cells_of(
    manifest: RSkillManifest, args: argparse.Namespace, out: Path, code: int
) -> list[Cell]:
    """Return a cell for each task of the environment; every task has the same seeds."""
    try:
        told = json.loads((out / RESULT).read_text(encoding="utf-8"))["per_task"]
    except (OSError, ValueError, KeyError):
        told = []
    cells = []
    for task in told:
        name = f"{task['task_group']}/{task['task_id']}" if len(told) > 1 else None
        cell = Cell(args.env, manifest.name, name, manifest.version)
        cell.episodes = [
            SeedOutcome(args.seed + index, bool(success))
            for index, success in enumerate(task["metrics"]["successes"])
        ]
        cell.complete = code == 0 and bool(cell.episodes)
        cells.append(cell)
    cells = cells or [Cell(args.env, manifest.name, None, manifest.version)]
    for cell in cells:
        cell.why = "" if cell.complete else f"{PROGRAM} ended with {code}"
    return cells
