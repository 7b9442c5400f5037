"""Policy sidecars with doors, in real processes beside the real daemon."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.support.paths import ROOT
from tests.support.prepared import start
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient
from vram_arbiter.schemas.runtime.ports import free_port

GRAB = "vram-arbiter/so101-grab"
KEY = "a-key-of-this-test"
GB = 10**9


class Served:
    """A sidecar of the shipped policy with a door at `port`."""

    def __init__(self, arbiter: ArbiterProcess, name: str, door: str, *flags: str) -> None:
        self.arbiter, self.port = arbiter, free_port()
        self.address = f"127.0.0.1:{self.port}"
        self.wire = WireClient(f"ipc://{arbiter.runtime}/{name}.sock")
        self.log = arbiter.runtime / f"{name}.log"
        arguments = [
            "--name", name, "--rskill", "so101-grab", "--footprint", "1GB,1GB,100MB",
            "--device", f"fake:{arbiter.gpu_folder}", "--min-residency-s", "0", "--nice", "0",
            "--door", door, "--listen", self.address, *flags,
        ]  # fmt: skip
        environ = arbiter.environ | {"OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as log:
            self.process = start(
                "vram-sidecar", arguments, environ, log.fileno(), log.fileno(), cwd=ROOT
            )

    def ready(self) -> None:
        until(lambda: "serves" in self.log.read_text() or self._ended(), 3 * PATIENCE_S)

    def _ended(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        return False

    def ask(self, **message: Any) -> Any:
        self.wire._id += 1
        self.wire.send_raw(msgpack.packb(message | {"id": self.wire._id}))
        return self.wire.reply(self.wire._id, PATIENCE_S)

    def state(self) -> str:
        state: str = self.ask(endpoint="ping")["state"]
        return state

    @contextmanager
    def evicted(self) -> Iterator[None]:
        """While another client has the GPU for itself."""
        footprint = {"load_peak_bytes": GB, "steady_bytes": GB, "residue_bytes": 0}
        spec = {"consumer": "other", "model_id": "other", "mode": "exclusive", "ttl_s": 600,
                "footprint": footprint}  # fmt: skip
        with WireClient(self.arbiter.endpoint) as other:
            other.hello("other")
            reply = other.ask("acquire", nonce=os.urandom(4).hex(), spec=spec)
            lease = other.push("granted")["lease"] if reply["state"] == "queued" else reply["lease"]
            assert self.state() != "resident"
            yield
            fields = {"lease_id": lease["lease_id"], "token": lease["token"]}
            assert other.ask("release", **fields)["ok"]

    def rss_bytes(self) -> int:
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * 4096

    def close(self) -> None:
        self.wire.close()
        self.process.terminate()
        assert self.process.wait(PATIENCE_S) == 0, self.log.read_text()


@contextmanager
def two_doors() -> Iterator[dict[str, Served]]:
    """Two sidecars of one policy: `lerobot`, at whose door robots may choose `openpi` too."""
    arbiter = ArbiterProcess(prepared=True).start()
    keys = arbiter.runtime / "keys"
    keys.write_text(f"another-key\n{KEY}\n")
    served = {
        "lerobot": Served(arbiter, "first", "lerobot", "--offer", "second"),
        "openpi": Served(arbiter, "second", "openpi", "--door-keys", str(keys)),
    }
    try:
        for one in served.values():
            one.ready()
        yield served
        for one in served.values():
            one.close()
    finally:
        for one in served.values():
            one.process.kill()
        arbiter.close()


@pytest.fixture(scope="session")
def doors() -> Iterator[dict[str, Served]]:
    with two_doors() as served:
        yield served


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The stock `lerobot.async_inference.robot_client`, which writes its log where it runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "plugin"))
    return importlib.import_module("lerobot.async_inference.robot_client")
