"""Play a scenario file as a test, on a private arbiter with a simulated GPU.

A scenario:

  gpu: 8GiB
  lag: 200ms
  consumers:
    detector: {vram: 5GiB, priority: 40}
    policy: {vram: 4GiB}
  steps:
    - start: detector
    - expect: {detector: held}
    - use: detector                     # a holder in use is not evicted
    - start: policy
    - expect: {detector: revoking, policy: queued}
    - idle: detector
    - expect: {detector: gone, policy: held}
    - evicted_once: detector
    - granted_before: [detector, policy]

consumers: vram, priority, standby
steps:     start, use, idle, stop, kill: a consumer
           expect: states as of `vramctl status`, or gone, within `within_s` (20) seconds
           stowaway: bytes of a process without a lease
           evicted_once: a consumer; granted_before: two of them
At the end the GPU must never have been overcommitted.

exit codes:
  0  every step passed
  1  a step failed; the timeline shows what happened
  2  wrong flags or a wrong file
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.version import add_version
from vram_arbiter.schemas.yamltext import read_text

NAME = "vram_arbiter.testing"


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {NAME}",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="YAML file")
    add_version(parser)
    file = parser.parse_args(argv).file
    from vram_arbiter.testing.scenario import load_scenario, play  # late: --help needs none of it

    try:
        scenario = load_scenario(read_text(file), str(file))
    except ConfigError as error:
        terminal.complain(NAME, error)
        return 2
    problem, told = play(scenario)
    print(told, f"{file}: {problem or 'passed'}", sep="\n")
    return int(bool(problem))


if __name__ == "__main__":
    sys.exit(main())
