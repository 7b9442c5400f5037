"""Options of `vram-reasoner`, and what is wrong with them before anything is waited for."""

import argparse
import os
from collections.abc import Mapping
from pathlib import Path

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.reasoner.llm.anthropic import AnthropicPlanner
from vram_arbiter.reasoner.llm.base import LlmPlanner
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.llm.http import import_httpx
from vram_arbiter.reasoner.llm.openai import OpenAiPlanner
from vram_arbiter.reasoner.llm.scripted import object_of
from vram_arbiter.reasoner.playbooks import Playbook, load_playbook
from vram_arbiter.schemas.errors import BadRequest, ConfigError
from vram_arbiter.schemas.manifest import LICENSE_FLAG, LICENSE_HELP
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime.endpoints import program_endpoint
from vram_arbiter.schemas.runtime.version import add_version

LLM_PLANNERS: dict[str, type[LlmPlanner]] = {"openai": OpenAiPlanner, "anthropic": AnthropicPlanner}
MANAGED = ("detector", "scene-vlm", "reward")
TASK_MAX_CHARS = 4000  # with what a planner says around it, a tool's text
ONE_OF_TEXTS = (  # one of these, or of the switches below, is given
    ("--task", "TASK", 'what to do, e.g. "grab the red cube"'),
    ("--say", "TEXT", "send a message to the planner of a running reasoner, and exit"),
    ("--cancel", "REASON", "end the task of a running reasoner and its goal, and exit"),
    ("--submit", "TASK", "queue a task at a serving reasoner, and exit"),
    ("--deny", "REASON", "refuse the waiting motion of a running reasoner, and exit"),
)
ONE_OF_SWITCHES = (
    ("--tasks", "list the tasks of a serving reasoner, as lines of JSON, and exit"),
    ("--confirm", "confirm the waiting motion of a running reasoner, and exit"),
)
SWITCHES = (
    (
        "--require-confirmation",
        "the operator confirms each motion: y on this terminal, or --confirm elsewhere",
    ),
    ("--look", "let the planner see the cameras' pictures: for language models that read images"),
    (LICENSE_FLAG, LICENSE_HELP),
)
FILES = (
    (
        "--transcript",
        "FILE",
        "append a language model's requests, answers and rejected answers, as lines of JSON",
    ),
    ("--playbook", "RSKILL.YAML", "the procedure that a language model follows"),
    ("--result", "FILE", "write the result as JSON into this file"),
    (
        "--history",
        "FILE",
        "with serve: append each finished task and its result, as lines of JSON",
    ),
)
SIDECAR = "ENDPOINT|MANIFEST"
ENDPOINTS = (
    ("--listen", "ENDPOINT", "socket for operators (default: ipc://RUNTIME/reasoner.sock)"),
    ("--runner", "ENDPOINT", "the runner (default: ipc://RUNTIME/runner.sock)"),
    ("--arbiter", "ENDPOINT", 'the arbiter, told what model follows; "none": it is not told'),
    ("--detector", SIDECAR, 'the detector sidecar, or a manifest to start it; "none": no detector'),
    ("--scene-vlm", SIDECAR, 'the scene-VLM sidecar, or a manifest to start it; "none": no VLM'),
)


def parser(description: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vram-reasoner",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_version(parser)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "command", nargs="?", choices=("serve",), help="serve tasks in sequence, from --submit"
    )
    for flag, metavar, text in ONE_OF_TEXTS:
        what.add_argument(flag, metavar=metavar, help=text)
    for flag, text in ONE_OF_SWITCHES:
        what.add_argument(flag, action="store_true", help=text)
    parser.add_argument(
        "--number",
        type=int,
        metavar="N",
        help="with --cancel: the task to end, even if it waits (default: the running one)",
    )
    parser.add_argument(
        "--planner",
        choices=("scripted", *LLM_PLANNERS),
        default="scripted",
        help="openai, anthropic: VRAM_REASONER_LLM_{BASE_URL,MODEL,API_KEY,TIMEOUT_S,MAX_TOKENS,"
        "BUSY_S} configure them",
    )
    for flag, text in SWITCHES:
        parser.add_argument(flag, action="store_true", help=text)
    for flag, metavar, text in FILES:
        parser.add_argument(flag, type=Path, metavar=metavar, help=text)
    for flag, metavar, text in ENDPOINTS:
        parser.add_argument(flag, metavar=metavar, help=text)
    parser.add_argument(
        "--reward",
        nargs="?",
        const="",
        default="none",
        metavar=SIDECAR,
        help="use a reward model to judge progress (default endpoint: ipc://RUNTIME/reward.sock),"
        " or start it from a manifest; without this flag there is none",
    )
    parser.add_argument(
        "--reward-camera", default="wrist", help="camera of the reward model (default: %(default)s)"
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
        "--log-format", choices=logs.FORMS, default="human", help="json: one object a line"
    )
    return parser


def endpoint(given: str | None, name: str) -> str:
    """Return the given endpoint, or the program's own."""
    return given or program_endpoint(name, os.environ, os.getuid())


def check_task(task: str, planner: str) -> None:
    """Raise BadRequest for a task that no planner, or not this one, could work with."""
    if not task.strip():
        raise BadRequest("the task is empty", hint='e.g. "grab the red cube"')
    if len(task) > TASK_MAX_CHARS:
        raise BadRequest(f"the task has more than {TASK_MAX_CHARS} characters", hint="shorten it")
    try:
        task.encode()
    except UnicodeEncodeError:
        raise BadRequest("the task has bytes that are not UTF-8") from None
    if planner not in LLM_PLANNERS:
        object_of(task)


def check_files(arguments: argparse.Namespace) -> None:
    """Raise ConfigError for a file of the other form: a task has a result, a service a history."""
    serves = arguments.command == "serve"
    if serves and arguments.result is not None:
        raise ConfigError("--result is for one task", hint="serve writes --history FILE")
    if not serves and arguments.history is not None:
        raise ConfigError("--history is for `vram-reasoner serve`", hint="use --result FILE")


def language_model(
    arguments: argparse.Namespace, environ: Mapping[str, str]
) -> tuple[LlmConfig | None, Playbook | None]:
    """Return the language model and the playbook that were asked for; None: none was.

    Raises ConfigError for options that only a language model can use, and what the configuration
    and the playbook raise.
    """
    for option in ("result", "history", "transcript"):
        check_output(f"--{option}", getattr(arguments, option))
    kind = LLM_PLANNERS.get(arguments.planner)
    llm = None
    if kind is not None:
        llm = LlmConfig.from_environ(environ, base_url=kind.default_base_url)
        import_httpx()
    playbook = load_playbook(arguments.playbook) if arguments.playbook else None
    for given, unused in (
        (playbook, "a playbook is read by a language model"),
        (arguments.look, "--look is for a language model"),
        (arguments.transcript, "--transcript is for a language model"),
    ):
        if given and llm is None:
            raise ConfigError(unused, hint=f"--planner {' or '.join(LLM_PLANNERS)}")
    return llm, playbook
