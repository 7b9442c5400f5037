"""`vram-reasoner`: what it refuses, and how it says so."""

import argparse
import json
import os
import sys
from functools import partial
from pathlib import Path

import pytest

from tests.support.process import ArbiterProcess
from vram_arbiter.clients.net.link import is_listening
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.reasoner.__main__ import main
from vram_arbiter.reasoner.options import parser
from vram_arbiter.reasoner.results import nothing_done
from vram_arbiter.reasoner.server import send
from vram_arbiter.reasoner.workplace import Workplace
from vram_arbiter.schemas.reasoner import Result

GRAB = ("--task", "grab the cube")


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ((*GRAB, "--say", "y"), 2, "not allowed with argument"),
        (("--say", "hello"), 3, "no reasoner answers"),
        (("--say", "x", "--listen", "reasoner.sock"), 2, "'reasoner.sock' is not an endpoint"),
        (("--task", " "), 2, "the task is empty"),
        (("--task", "grab the \udcff cube"), 2, "the task has bytes that are not UTF-8"),
        (("--task", "grab a " + "very " * 2000 + "red cube"), 2, "the task has more than"),
        (("serve", "--result", "r.json"), 2, "serve writes --history FILE"),
        ((*GRAB, "--result", "DIR/file/r.json"), 2, "--result DIR/file/r.json cannot be written"),
        ((*GRAB, "--result", "DIR"), 2, "--result DIR cannot be written"),
        ((*GRAB, "--playbook", "DIR/none/rskill.yaml"), 2, "cannot be read"),
        ((*GRAB, "--planner", "openai"), 2, "LLM_BASE_URL and VRAM_REASONER_LLM_MODEL not set"),
        ((*GRAB, "--look"), 2, "--look is for a language model (--planner openai or anthropic"),
        ((*GRAB, "--runner", "runner.sock"), 2, "'runner.sock' is not an endpoint"),
        ((*GRAB, "--detector", "so101-scene-vlm"), 2, "is a vlm, expected a detector"),
        ((*GRAB, "--detector", "no/such"), 2, "no/such: cannot be read"),
        ((*GRAB, "--listen", "tcp://127.0.0.1:7"), 2, "any user of the machine"),
    ],
)
def test_what_is_wrong_is_said_before_anything_moves(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    code: int,
    said: str,
) -> None:
    """Regression: an undecodable byte, or a task of many pages, ended in a traceback; a result file
    that could not be written in one behind the episode.
    """
    (tmp_path / "file").touch()
    for name in [name for name in os.environ if name.startswith("VRAM_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path))
    monkeypatch.setattr("vram_arbiter.reasoner.__main__.send", partial(send, timeout_s=0.1))
    given = [argument.replace("DIR", str(tmp_path)) for argument in arguments]
    sidecars = ["--detector", "none", "--scene-vlm", "none"]
    monkeypatch.setattr(sys, "argv", ["vram-reasoner", *sidecars, *given])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == code
    (*_, line) = capsys.readouterr().err.splitlines()
    assert line.startswith("vram-reasoner: ")
    assert said.replace("DIR", str(tmp_path)) in line


def test_the_result_is_a_file_and_an_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fails(arguments: argparse.Namespace) -> Result:
        return nothing_done(arguments.task, "out of luck")

    monkeypatch.setattr("vram_arbiter.reasoner.__main__._one_task", fails)
    file = tmp_path / "result.json"
    monkeypatch.setattr(sys, "argv", ["vram-reasoner", *GRAB, "--result", str(file)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert json.loads(file.read_text())["reason"] == "out of luck"


@pytest.mark.heavy
@pytest.mark.e2e
@pytest.mark.anyio
async def test_a_sidecar_is_there_as_long_as_the_reasoner_that_starts_it(
    arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in arbiter_daemon.environ.items():
        monkeypatch.setenv(name, value)
    given = [*GRAB, "--detector", "so101-detector", "--scene-vlm", "none"]
    client = DetectorClient(f"ipc://{arbiter_daemon.runtime}/detector.sock")
    async with client, Workplace(parser(None).parse_args(given), None, None, None):
        assert (await client.ping())["rskill"] == "vram-arbiter/so101-detector"
    assert not is_listening(client.endpoint)
