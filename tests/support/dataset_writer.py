"""Writers of datasets, forked from a process that has imported lerobot: 8 s of a core each.

`FORKING` stands for the module `subprocess` in `vram_arbiter.runner.recording.recorder`.
"""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from tests.support.prepared import Forked, start


def main() -> int:
    """The writer itself, in the forked process."""
    from vram_arbiter.runner.recording import writer

    return writer.main(sys.argv[1:])


def _popen(
    command: Sequence[str],
    *,
    pass_fds: Sequence[int],
    env: Mapping[str, str],
    start_new_session: bool,
    **_: Any,
) -> Forked:
    module, descriptor = command[-2:]
    assert module == "vram_arbiter.runner.recording.writer"
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        return start(
            "dataset-writer", [descriptor], env, nowhere, 2,
            passed=pass_fds, session=start_new_session,
        )  # fmt: skip
    finally:
        os.close(nowhere)


FORKING = SimpleNamespace(
    Popen=_popen, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired
)
