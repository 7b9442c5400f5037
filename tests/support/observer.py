"""A real `vram-observer` beside a daemon of the tests, ended by its pid."""

import re
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from tests.support.waiting import until

STOP_S = 60.0


class ObserverProcess:
    """`with ObserverProcess(arbiter) as observer`: observes from the first later event on."""

    def __init__(
        self,
        arbiter: ArbiterProcess,
        arguments: Sequence[str] = ("--http", "127.0.0.1:0"),
        environ: Mapping[str, str] | None = None,
        config: str = "{}",
    ) -> None:
        file = arbiter.runtime / "observer.yaml"
        file.write_text(config)
        file.chmod(0o600)
        state = arbiter.runtime / "observer" / "hooks.json"
        self._arguments = ["--config", str(file), "--state", str(state), *arguments]
        self._environ = {**arbiter.environ, **(environ or {})}
        self._log = arbiter.runtime / "observer.log"
        self.process: Forked | None = None

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    @property
    def port(self) -> int:
        found = until(lambda: re.findall(r"status page: http://127\.0\.0\.1:(\d+)", self.log))
        return int(found[-1])

    def spawn(self) -> Self:
        """Start without waiting for the arbiter."""
        with self._log.open("wb") as log:
            self.process = start(
                "vram-observer", self._arguments, self._environ, log.fileno(), log.fileno()
            )
        return self

    def start(self) -> Self:
        """Start, and wait until no later event can be missed."""
        self.spawn()
        until(self._observes)
        return self

    def _observes(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, self.log
        return "observes the arbiter" in self.log

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        assert self.process is not None
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(STOP_S)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


def config_file(folder: Path, text: str) -> Path:
    file = folder / "observer.yaml"
    file.write_text(text)
    file.chmod(0o600)
    return file
