"""Run a program that knows nothing of the arbiter under a lease, for its whole life.

    python examples/wrap_program.py 5GB python train.py

`vramctl run` does the same with more options. The bytes of a child process count as its parent's,
so the lease of this program covers them. When the arbiter needs the room, the program is ended;
wrap `program.wait()` in `lease.use("run")` to let it finish first.
"""

import os
import subprocess
import sys
from pathlib import Path

from vram_arbiter import Client, Footprint
from vram_arbiter.clients.cuda import visible
from vram_arbiter.schemas.sizes import parse_bytes


def run(vram: str, command: list[str]) -> int:
    size = parse_bytes(vram)
    # the program exits, so nothing of it stays on the GPU
    footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=0)
    program: subprocess.Popen[bytes] | None = None

    def end() -> None:
        if program is not None and program.poll() is None:
            print("the room is needed: ending the program", flush=True)
            program.terminate()
            program.wait()

    with (
        Client(Path(command[0]).name) as arbiter,
        arbiter.lease(vram=footprint, priority=40, unload=end, min_residency_s=0.0) as lease,
    ):
        environ = {**os.environ, **visible(lease.gpu, os.environ)}
        program = subprocess.Popen(command, env=environ)
        lease.ready()
        code = program.wait()
    return code if code >= 0 else 128 - code


def main(arguments: list[str]) -> int:
    if len(arguments) < 2:
        print("usage: wrap_program.py VRAM PROGRAM [ARGUMENT ...]", file=sys.stderr)
        print("example: wrap_program.py 5GB python train.py", file=sys.stderr)
        return 2
    return run(arguments[0], arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
