"""The grab policy's sidecar and a runner as real processes beside a real daemon, and a scenario
that is played against them.
"""

import asyncio
import subprocess
from collections.abc import Coroutine
from typing import Any

import pytest

from tests.support.paths import ROOT
from tests.support.prepared import start
from tests.support.process import ArbiterProcess

SKILLS = ROOT / "configs/rskills"
SKILL = SKILLS / "so101-grab/rskill.yaml"
GRAB = "vram-arbiter/so101-grab"
SCENARIO_S = 280.0
# of a goal, with its policy's first load: on a busy machine importing torch alone takes a minute
GOAL_S = 200.0


def need_checkpoint() -> None:
    """Skip the test where the shipped weights are missing."""
    if not (ROOT / "configs/models/so101-grab/model.safetensors").exists():
        pytest.skip("the grab checkpoint is not in this tree")


class GrabPrograms:
    """Both programs in the daemon's runtime folder; `runner` are the words after `vram-runner`."""

    def __init__(self, arbiter: ArbiterProcess, *runner: str) -> None:
        self.log = arbiter.runtime / "programs.log"
        environ = arbiter.environ | {"OMP_NUM_THREADS": "1"}
        sidecar = [
            "--name",
            "grab",
            "--rskill",
            str(SKILL),
            "--device",
            f"fake:{arbiter.gpu_folder}",
        ]
        with self.log.open("ab") as log:
            self.sidecar, self.runner = (
                start(program, words, environ, log.fileno(), log.fileno(), cwd=ROOT)
                for program, words in (("vram-sidecar", sidecar), ("vram-runner", runner))
            )

    def play(self, scenario: Coroutine[Any, Any, None]) -> None:
        """Run it; a failure shows what the programs said."""

        async def bounded() -> None:
            async with asyncio.timeout(SCENARIO_S):
                await scenario

        try:
            asyncio.run(bounded())
        except Exception:
            print(self.log.read_text(errors="replace")[-4000:])
            raise

    def close(self) -> None:
        for process in (self.runner, self.sidecar):
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
