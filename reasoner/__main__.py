"""`vram-reasoner`: run one task with the runner and the sidecars that are there.

Exit codes: 0 the task succeeded, 1 it failed, 2 wrong usage or configuration, 3 the runner cannot be reached.
"""

import argparse
import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from pathlib import Path

from clients.runner import RunnerClient
from clients.sidecar.perception import DetectorClient, SceneVlmClient
from reasoner.llm.openai import LlmConfig, OpenAiPlanner
from reasoner.llm.scripted import ScriptedPlanner
from reasoner.loop import Result, run_episode
from reasoner.palette import Palette, palette_of
from reasoner.planner import Planner
from reasoner.tools import Tools
from schemas.endpoints import program_endpoint
from schemas.errors import RunnerUnreachable, SidecarUnavailable, VramError
from schemas.manifest import RSkillManifest

EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE = 1, 2, 3


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vram-reasoner", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True, help='what to do, e.g. "grab the red cube"')
    parser.add_argument(
        "--planner",
        choices=("scripted", "openai"),
        default="scripted",
        help="openai: VRAM_REASONER_LLM_BASE_URL and _MODEL say where",
    )
    parser.add_argument("--runner", help="endpoint of the runner (default: ipc://RUNTIME/runner.sock)")
    parser.add_argument("--detector", help='endpoint of the detector sidecar; "none": there is none')
    parser.add_argument("--scene-vlm", help='endpoint of the scene-VLM sidecar; "none": there is none')
    parser.add_argument("--result", type=Path, help="write the result as JSON into this file")
    return parser


def main() -> None:
    arguments = _parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s", stream=sys.stderr)
    try:
        result = asyncio.run(_run(arguments))
    except (RunnerUnreachable, SidecarUnavailable) as error:
        sys.exit(_complain(error, EXIT_UNREACHABLE))
    except VramError as error:
        sys.exit(_complain(error, EXIT_USAGE))
    except asyncio.CancelledError:
        sys.exit(EXIT_FAILED)
    if arguments.result is not None:
        arguments.result.write_text(json.dumps(result, indent=2) + "\n")
    sys.exit(0 if result["status"] == "success" else EXIT_FAILED)


def _complain(error: VramError, code: int) -> int:
    print(f"vram-reasoner: {error}", file=sys.stderr)
    return code


async def _run(arguments: argparse.Namespace) -> Result:
    task = asyncio.current_task()
    assert task is not None, "inside asyncio.run there is a current task"
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    async with contextlib.AsyncExitStack() as stack:
        runner = await stack.enter_async_context(RunnerClient(_endpoint(arguments.runner, "runner")))
        detector = vlm = None
        if arguments.detector != "none":
            detector = await stack.enter_async_context(
                DetectorClient(_endpoint(arguments.detector, "detector"))
            )
        if arguments.scene_vlm != "none":
            vlm = await stack.enter_async_context(SceneVlmClient(_endpoint(arguments.scene_vlm, "scene-vlm")))
        manifests = [
            RSkillManifest.model_validate(manifest) for manifest in (await runner.skills())["skills"]
        ]
        palette = palette_of(manifests, can_locate=detector is not None, can_query=vlm is not None)
        planner = await _planner(arguments, palette, stack)
        return await run_episode(arguments.task, planner, palette, Tools(runner, detector, vlm))


async def _planner(
    arguments: argparse.Namespace, palette: Palette, stack: contextlib.AsyncExitStack
) -> Planner:
    if arguments.planner == "scripted":
        return ScriptedPlanner(arguments.task, palette)
    return await stack.enter_async_context(OpenAiPlanner(LlmConfig.from_environ(os.environ), palette))


def _endpoint(given: str | None, name: str) -> str:
    return given or program_endpoint(name, os.environ, os.getuid())


if __name__ == "__main__":
    main()
