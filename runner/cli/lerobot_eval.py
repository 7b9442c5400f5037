"""A skill's checkpoint in an environment of lerobot, by `lerobot-eval` under a lease.

lerobot makes the environment and plays the checkpoint in a process of its own: neither the sidecar
nor this runner's gate takes part.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import sys
from pathlib import Path

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli.benchmark_report import REPORT, table, write_report
from vram_arbiter.runner.cli.common import default_skills
from vram_arbiter.runner.goals.catalogue import read_manifests
from vram_arbiter.runner.sim.benchmark import Cell, SeedOutcome
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.runtime.printable import printable_lines

PROGRAM = "lerobot-eval"
RESULT = "eval_info.json"


async def evaluate(args: argparse.Namespace) -> int:
    """Play every `--skill` in the environment; write the report and print the table.

    Returns: 0 if every episode got a verdict, 1 otherwise. Raises ConfigError, UnknownSkill.
    """
    if args.policy or args.task or args.scene or args.record or not args.skill:
        raise ConfigError(
            f"--env {args.env} plays the checkpoints of skills: give --skill, and neither --policy,"
            " --task, --scene nor --record"
        )
    program = shutil.which(PROGRAM, path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if program is None:
        raise ConfigError(
            f"--env {args.env} needs {PROGRAM}", hint="pip install 'vram-arbiter[sidecars]'"
        )
    manifests = {one.name: one for one in read_manifests(args.skills or [default_skills()])}
    wanted = [_policy(manifests.get(name), name, args) for name in dict.fromkeys(args.skill)]
    check_output("--out", args.out / REPORT)
    cells = []
    for manifest in wanted:
        out = args.out / f"{args.env}_{manifest.name.replace('/', '-')}"
        command = [program, *flags_of(manifest, args, out)]
        if not args.no_arbiter:
            command = [*_lease(manifest, args), *command]
        process = await asyncio.create_subprocess_exec(*command)
        code = await process.wait()
        cells.append(_cell(manifest, args, out, code))
        write_report(args, cells, complete=len(cells) == len(wanted))
    print(printable_lines(table([cell.summary() for cell in cells])))
    print(f"{args.out / REPORT}")
    return 0 if all(cell.complete for cell in cells) else 1


def _policy(manifest: RSkillManifest | None, name: str, args: argparse.Namespace) -> RSkillManifest:
    if manifest is None or manifest.kind is not Kind.VLA or not manifest.weights_uri:
        raise ConfigError(f"--skill {name}: no policy of that name is installed")
    if why := manifest.license_refusal(allow_noncommercial=args.allow_noncommercial):
        raise ConfigError(f"--skill {name}: {why}")
    return manifest


def flags_of(manifest: RSkillManifest, args: argparse.Namespace, out: Path) -> list[str]:
    """Return the arguments of `lerobot-eval`."""
    where, _, place = (manifest.weights_uri or "").partition("://")
    path, _, revision = place.partition("@")
    if where == "local":
        path = str(configs_folder(os.environ) / path)
    return [
        f"--policy.path={path}",
        *([f"--policy.pretrained_revision={revision}"] if revision else []),
        f"--env.type={args.env}",
        f"--eval.n_episodes={args.episodes}",
        f"--seed={args.seed}",
        f"--output_dir={out}",
        *args.lerobot_flags,
    ]


def _lease(manifest: RSkillManifest, args: argparse.Namespace) -> list[str]:
    """Return what runs a program under a lease of the bytes that the manifest declares."""
    declared_gb = manifest.declared_vram_gb
    if declared_gb is None:
        raise ConfigError(
            f"{manifest.name} does not declare min_vram_gb for {manifest.quantization.dtype}",
            hint="declare it, or run with --no-arbiter",
        )
    endpoint = ["--endpoint", args.arbiter] if args.arbiter else []
    run = [sys.executable, "-P", "-m", "vram_arbiter.clients", "run", *endpoint]
    return [*run, "--vram", f"{declared_gb:g}GB", "--name", PROGRAM, "--"]


def _cell(manifest: RSkillManifest, args: argparse.Namespace, out: Path, code: int) -> Cell:
    cell = Cell(args.env, manifest.name, None, manifest.version)
    try:
        told = json.loads((out / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        told = {"per_task": []}
    successes = [one for task in told["per_task"] for one in task["metrics"]["successes"]]
    cell.episodes = [
        SeedOutcome(args.seed + index, bool(success)) for index, success in enumerate(successes)
    ]
    cell.complete = code == 0 and bool(successes)
    cell.why = "" if cell.complete else f"{PROGRAM} ended with {code}"
    return cell
