"""Programs beside a daemon, which send their telemetry to a collector."""

import signal

from tests.support.paths import ROOT
from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess

STOP_S = 60.0


class Programs:
    """Everything beside the daemon, in its runtime folder, each telling the collector."""

    def __init__(self, arbiter: ArbiterProcess, environ: dict[str, str]) -> None:
        self.log = arbiter.runtime / "programs.log"
        self._environ = arbiter.environ | environ
        self._running: list[Forked] = []

    def start(self, program: str, *argv: str) -> None:
        with self.log.open("ab") as log:
            made = start(program, argv, self._environ, log.fileno(), log.fileno(), cwd=ROOT)
        self._running.append(made)

    def end(self) -> list[int]:
        """SIGTERM to each, the last started first; their exit codes."""
        codes = []
        for process in reversed(self._running):
            process.send_signal(signal.SIGTERM)
            codes.append(process.wait(STOP_S))
        return codes

    def close(self) -> None:
        for process in self._running:
            if process.poll() is None:
                process.kill()
                process.wait()
