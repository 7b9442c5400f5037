"""Workers of `vram-runner benchmark`, forked from a process that has imported the runner: 3 s of a
core each.

`FORKING` stands for the module `subprocess` in `vram_arbiter.runner.benchmark.processes`.
"""

import subprocess
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from tests.support.prepared import Forked, start


def _popen(
    command: Sequence[str], *, pass_fds: Sequence[int], env: Mapping[str, str], **_: Any
) -> Forked:
    assert command[1:3] == ["-m", "vram_arbiter.runner"]
    return start("vram-runner", command[3:], env, 2, 2, passed=pass_fds)


FORKING = SimpleNamespace(Popen=_popen, DEVNULL=subprocess.DEVNULL)
