"""`vram-reasoner`: run one task with the present runner and sidecars, or message a running one.

Exit codes: 0 the task succeeded, 1 it failed, 2 wrong usage or configuration, 3 the runner, or the
addressed reasoner, cannot be reached.
"""

import argparse
import asyncio
import contextlib
import json
import os
import signal
import sys
from pathlib import Path

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.reasoner.history import RATE_HZ, Past
from vram_arbiter.reasoner.inbox import Inbox
from vram_arbiter.reasoner.llm.anthropic import AnthropicPlanner
from vram_arbiter.reasoner.llm.base import LlmConfig, LlmPlanner
from vram_arbiter.reasoner.llm.openai import OpenAiPlanner
from vram_arbiter.reasoner.llm.scripted import ScriptedPlanner
from vram_arbiter.reasoner.loop import STEPS_MAX, Result, run_episode
from vram_arbiter.reasoner.palette import OPERATOR, Palette, palette_of
from vram_arbiter.reasoner.planner import Planner
from vram_arbiter.reasoner.playbooks import Playbook, load_playbook
from vram_arbiter.reasoner.server import OperatorServer, send
from vram_arbiter.reasoner.tools import FRAME_MAX_AGE_MS, Judge, Tools
from vram_arbiter.reasoner.watch import watch
from vram_arbiter.schemas.body import read_body
from vram_arbiter.schemas.errors import (
    BadRequest,
    ConfigError,
    ReasonerUnreachable,
    RunnerUnreachable,
    SidecarUnavailable,
    VramError,
)
from vram_arbiter.schemas.manifest import LICENSE_FLAG, LICENSE_HELP, RSkillManifest
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.endpoints import program_endpoint
from vram_arbiter.schemas.runtime.telemetry.commands import command
from vram_arbiter.schemas.runtime.version import add_version

LLM_PLANNERS: dict[str, type[LlmPlanner]] = {"openai": OpenAiPlanner, "anthropic": AnthropicPlanner}
MANAGED = ("detector", "scene-vlm", "reward")

TASK_MAX_CHARS = 4000  # with what a planner says around it, a tool's text

EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE = 1, 2, 3


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vram-reasoner",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_version(parser)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--task", help='what to do, e.g. "grab the red cube"')
    what.add_argument(
        "--say", metavar="TEXT", help="tell the planner of a running reasoner something, and end"
    )
    what.add_argument(
        "--cancel",
        metavar="REASON",
        help="end the episode of a running reasoner and its goal, and end",
    )
    parser.add_argument(
        "--planner",
        choices=("scripted", *LLM_PLANNERS),
        default="scripted",
        help="openai, anthropic: VRAM_REASONER_LLM_{BASE_URL,MODEL,API_KEY,TIMEOUT_S,MAX_TOKENS}"
        " configure them",
    )
    parser.add_argument(
        "--playbook",
        type=Path,
        metavar="RSKILL.YAML",
        help="the procedure that a language model follows",
    )
    parser.add_argument(
        "--manage",
        action="append",
        default=[],
        choices=MANAGED,
        help="a sidecar that the planner may load and unload (repeatable;"
        " default: none, the arbiter decides)",
    )
    parser.add_argument(
        LICENSE_FLAG,
        action="store_true",
        help=LICENSE_HELP,
    )
    parser.add_argument(
        "--listen", help="where to hear --say and --cancel (default: ipc://RUNTIME/reasoner.sock)"
    )
    parser.add_argument(
        "--runner", help="endpoint of the runner (default: ipc://RUNTIME/runner.sock)"
    )
    parser.add_argument(
        "--detector", help='endpoint of the detector sidecar; "none": there is none'
    )
    parser.add_argument(
        "--scene-vlm", help='endpoint of the scene-VLM sidecar; "none": there is none'
    )
    parser.add_argument(
        "--log-format", choices=logs.FORMS, default="human", help="json: one object a line"
    )
    parser.add_argument(
        "--reward",
        nargs="?",
        const="",
        metavar="ENDPOINT",
        help="ask a reward model for progress (default endpoint: ipc://RUNTIME/reward.sock);"
        " without this flag there is none",
    )
    parser.add_argument(
        "--reward-camera", default="wrist", help="which camera it looks at (default: %(default)s)"
    )
    parser.add_argument("--result", type=Path, help="write the result as JSON into this file")
    return parser


@terminal.program
def main() -> int:
    arguments = _parser().parse_args()
    logs.set_up("vram-reasoner", "info", arguments.log_format, "%(asctime)s %(name)s %(message)s")
    what = (
        "task" if arguments.task is not None else "say" if arguments.say is not None else "cancel"
    )
    try:
        with command("vram-reasoner", what):
            _main(arguments)
    except ConfigError as error:  # of the telemetry: everything else is said within
        return _complain(error, EXIT_USAGE)
    return 0


def _main(arguments: argparse.Namespace) -> None:
    """Exits with the code, unless that is 0."""
    try:
        if arguments.task is None:
            asyncio.run(_speak(arguments))
            return
        _check_task(arguments.task)
        check_output("--result", arguments.result)
        result = asyncio.run(_run(arguments))
    except (RunnerUnreachable, SidecarUnavailable, ReasonerUnreachable) as error:
        sys.exit(_complain(error, EXIT_UNREACHABLE))
    except VramError as error:
        sys.exit(_complain(error, EXIT_USAGE))
    except asyncio.CancelledError:
        sys.exit(EXIT_FAILED)
    if arguments.result is not None:
        arguments.result.write_text(json.dumps(result, indent=2) + "\n")
    sys.exit(0 if result["status"] == "success" else EXIT_FAILED)


def _check_task(task: str) -> None:
    """Return the task's text. Raises BadRequest for one that no planner could work with."""
    if len(task) > TASK_MAX_CHARS:
        raise BadRequest(
            f"the task has more than {TASK_MAX_CHARS} characters", hint="say it shorter"
        )
    try:
        task.encode()
    except UnicodeEncodeError:
        raise BadRequest("the task has bytes that are not UTF-8") from None


def _complain(error: VramError, code: int) -> int:
    terminal.complain("vram-reasoner", error)
    return code


async def _speak(arguments: argparse.Namespace) -> None:
    said = arguments.say is not None
    request = (
        {"op": "say", "text": arguments.say}
        if said
        else {"op": "cancel", "reason": arguments.cancel}
    )
    await send(_endpoint(arguments.listen, "reasoner"), request)


async def _run(arguments: argparse.Namespace) -> Result:
    task = asyncio.current_task()
    assert task is not None, "inside asyncio.run there is a current task"
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    async with contextlib.AsyncExitStack() as stack:
        llm = _checked(arguments)
        playbook = load_playbook(arguments.playbook) if arguments.playbook else None
        if playbook is not None and arguments.planner not in LLM_PLANNERS:
            raise ConfigError(
                "a playbook is read by a language model",
                hint=f"--planner {' or '.join(LLM_PLANNERS)}",
            )
        inbox = Inbox()
        await stack.enter_async_context(
            OperatorServer(_endpoint(arguments.listen, "reasoner"), arguments.task, inbox)
        )
        runner = await stack.enter_async_context(
            RunnerClient(_endpoint(arguments.runner, "runner"))
        )
        eyes = await stack.enter_async_context(RunnerClient(_endpoint(arguments.runner, "runner")))
        detector = vlm = None
        if arguments.detector != "none":
            detector = await stack.enter_async_context(
                DetectorClient(_endpoint(arguments.detector, "detector"))
            )
        if arguments.scene_vlm != "none":
            vlm = await stack.enter_async_context(
                SceneVlmClient(_endpoint(arguments.scene_vlm, "scene-vlm"))
            )
        reward = None
        if arguments.reward is not None:
            reward = await stack.enter_async_context(
                RewardClient(_endpoint(arguments.reward, "reward"))
            )
        named = {"detector": detector, "scene-vlm": vlm, "reward": reward}
        components = {name: client for name, client in named.items() if client is not None}
        installed = await runner.skills()
        manifests = [RSkillManifest.model_validate(manifest) for manifest in installed["skills"]]
        palette = palette_of(
            manifests,
            can_locate=detector is not None,
            can_query=vlm is not None,
            can_judge=reward is not None,
            allow_noncommercial=arguments.allow_noncommercial,
            managed=[name for name in arguments.manage if name in components],
            topics=[OPERATOR],
            body=read_body(installed.get("body")),
        )
        if playbook is not None:
            palette = playbook.narrow(palette)
        judge = await _judge(arguments, reward, manifests, stack) if reward is not None else None
        planner = await _planner(arguments, llm, palette, playbook, stack)
        watching = asyncio.create_task(watch(eyes, inbox))
        stack.callback(watching.cancel)
        return await run_episode(
            arguments.task,
            planner,
            palette,
            Tools(runner, detector, vlm, judge=judge, palette=palette, components=components),
            inbox=inbox,
            steps_max=STEPS_MAX if playbook is None else min(STEPS_MAX, playbook.max_steps),
        )


async def _judge(
    arguments: argparse.Namespace,
    reward: RewardClient,
    manifests: list[RSkillManifest],
    stack: contextlib.AsyncExitStack,
) -> Judge:
    """Return the reward model with a history of pictures, taken as often as its manifest wants
    them.

    The pictures have a connection of their own.
    """
    camera = arguments.reward_camera
    eyes = await stack.enter_async_context(RunnerClient(_endpoint(arguments.runner, "runner")))
    rates = [manifest.reward.target_fps for manifest in manifests if manifest.reward is not None]
    past = Past(
        lambda: eyes.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png"),
        rate_hz=min(rates, default=RATE_HZ),
    )
    looking = asyncio.create_task(past.run(), name="past")
    stack.callback(looking.cancel)
    return Judge(reward, past, arguments.task)


def _checked(arguments: argparse.Namespace) -> LlmConfig | None:
    """Raise ConfigError for mistakes that would otherwise show late: after the wait or the
    episode.
    """
    if not arguments.task.strip():
        raise ConfigError("--task says nothing", hint='e.g. --task "grab the red cube"')
    path: Path | None = arguments.result
    if path is not None and (
        path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK)
    ):
        raise ConfigError(
            f"--result {path} cannot be written", hint="name a file in a folder of your own"
        )
    if arguments.planner == "scripted":
        return None
    return LlmConfig.from_environ(
        os.environ, base_url=LLM_PLANNERS[arguments.planner].default_base_url
    )


async def _planner(
    arguments: argparse.Namespace,
    llm: LlmConfig | None,
    palette: Palette,
    playbook: Playbook | None,
    stack: contextlib.AsyncExitStack,
) -> Planner:
    if llm is None:
        return ScriptedPlanner(arguments.task, palette)
    kind = LLM_PLANNERS[arguments.planner]
    procedure = playbook.procedure if playbook is not None else ""
    return await stack.enter_async_context(kind(llm, palette, procedure=procedure))


def _endpoint(given: str | None, name: str) -> str:
    return given or program_endpoint(name, os.environ, os.getuid())


if __name__ == "__main__":
    sys.exit(main())
