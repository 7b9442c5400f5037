"""A real daemon with `--gpu nvml` on a compiled library: grant → release → verdict, with lag, N/A,
errors and a call that hangs."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.nvml_stub import GIB, MIB, NvmlStub
from tests.support.process import ArbiterProcess, Make
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e
pytest.importorskip("pynvml")
ME = os.getpid()
CONFIG = "probe: {deadline_s: 60.0, period_s: 0.1}\nverify: {timeout_s: 3.0, slow_poll_s: 0.1}\n"
HANGS = CONFIG.replace("deadline_s: 60.0", "deadline_s: 0.4")
"""A busy machine misses this deadline now and then, too."""


@pytest.fixture
def daemon(nvml: NvmlStub, make_arbiter: Make, request: pytest.FixtureRequest) -> ArbiterProcess:
    """`indirect` parametrization gives another configuration."""
    return make_arbiter(gpu="nvml", config=getattr(request, "param", CONFIG)).start(nvml.environ)


@pytest.fixture
def client(daemon: ArbiterProcess) -> Iterator[WireClient]:
    with WireClient(daemon.endpoint) as client:
        yield client.hello("holder")


def granted(client: WireClient, name: str, size: int, **spec: Any) -> dict[str, Any]:
    """Acquire and wait for the grant."""
    lease = client.granted(name, size, ttl_s=60.0, **spec)
    return {"lease_id": lease["lease_id"], "token": lease["token"]}


def held_here(client: WireClient, nvml: NvmlStub, size: int) -> dict[str, Any]:
    """This very process holds a lease and its bytes."""
    on = granted(client, "holder", size)
    nvml.gpu(size)
    nvml.write(f"process 0 compute {ME} {size}")
    assert client.ask("ready", **on, measured_bytes=size)["ok"]
    until_read(client, size)
    return on


def until_read(client: WireClient, used: int) -> None:
    """Until the daemon has read so much: what a release is compared with."""
    deadline = time.monotonic() + PATIENCE_S
    while client.ask("status")["gpus"][0]["measured_used_bytes"] != used:
        assert time.monotonic() < deadline, "the GPU is not read"


def let_go(client: WireClient, nvml: NvmlStub, on: dict[str, Any], left: int, *lines: str) -> None:
    """As holders do: say so first, so that no reading of what is half gone is taken for the state
    before; give back; release."""
    assert client.ask("unloading", **on)["ok"]
    nvml.gpu(left)
    nvml.write(*lines)
    assert client.ask("release", **on)["ok"]


def event(
    client: WireClient, kind: str, where: Callable[[dict[str, Any]], bool] = lambda _: True
) -> dict[str, Any]:
    """The next event of a kind, for who has subscribed."""
    found = client.push(
        "event", where=lambda push: push["event"]["kind"] == kind and where(push["event"])
    )
    happened: dict[str, Any] = found["event"]
    return happened


@pytest.mark.parametrize(
    "daemon", [CONFIG.replace("timeout_s: 3.0", "timeout_s: 60.0")], indirect=True
)
def test_a_cycle_with_release_lag(
    client: WireClient, daemon: ArbiterProcess, nvml: NvmlStub
) -> None:
    (gpu,) = client.ask("status")["gpus"]
    assert (gpu["gpu"], gpu["name"]) == ("GPU-stub-0", "NVIDIA Stub")
    assert gpu["capacity_bytes"] == 8 * GIB - 256 * MIB, "less what the driver keeps"
    assert client.ask("subscribe")["ok"]
    on = held_here(client, nvml, 5 * GIB)
    # the driver takes its time
    let_go(client, nvml, on, 5 * GIB, f"process 0 compute {ME} {5 * GIB}")
    waiter = client.acquire("next", 5 * GIB, nonce="next")
    assert waiter["state"] == "queued", "released is not free"
    event(client, "queued", lambda told: told["lease_id"] == waiter["lease"]["lease_id"])
    before = client.ask("status")
    assert [lease["state"] for lease in before["leases"]] == ["verifying", "queued"], (
        "not before the GPU shows it"
    )
    nvml.gpu(0)
    nvml.write()
    assert client.push("granted")["lease"]["lease_id"] == waiter["lease"]["lease_id"]
    verdict = event(client, "verified")
    assert (verdict["verdict"], verdict["resolved"], verdict["culprits"]) == ("verified", True, [])
    assert (verdict["before_bytes"], verdict["after_bytes"]) == (5 * GIB, 0)


def test_an_instance_is_leased_by_itself(nvml: NvmlStub, make_arbiter: Make) -> None:
    """Two loads at once, one on each instance: a GPU has one at a time."""
    nvml.instances(0, 0)
    nvml.write()
    daemon = make_arbiter(gpu="nvml", config=CONFIG).start(nvml.environ)
    with WireClient(daemon.endpoint) as client:
        client.hello("holder")
        first, second = (client.granted(name, 3 * GIB) for name in ("first", "second"))
        assert {first["gpu"], second["gpu"]} == {"MIG-stub-1", "MIG-stub-2"}
        refused = client.acquire("large", 5 * GIB)
        assert refused["error"]["code"] == "vram_insufficient", "no more than an instance has"


@pytest.mark.parametrize("daemon", [HANGS], indirect=True)
def test_a_call_that_hangs_is_unknown_blocks_and_recovers(
    client: WireClient, nvml: NvmlStub
) -> None:
    assert client.ask("subscribe")["ok"]
    on = held_here(client, nvml, 5 * GIB)
    let_go(client, nvml, on, 0, "hang memory")
    assert "no answer within 0.4 s" in event(client, "probe_failed")["reason"]
    assert event(client, "verified")["verdict"] == "stale"
    waiter = client.acquire("next", GIB, nonce="next")
    assert waiter["state"] == "queued"
    (gpu,) = client.ask("status")["gpus"]
    assert gpu["measured_used_bytes"] is None
    assert "cannot be read" in gpu["blocked"]["text"]
    assert client.ask("ping")["ok"], "the daemon itself hangs on nothing"
    nvml.write()
    event(client, "probe_ok")
    client.push("granted")


def test_a_sensor_that_hangs_delays_nothing(client: WireClient, nvml: NvmlStub) -> None:
    nvml.write("hang sensors")
    assert "sensors" not in client.ask("status")["gpus"][0]
    assert granted(client, "holder", GIB)
    assert client.ask("status")["gpus"][0]["measured_used_bytes"] == 0, "memory is still read"
    nvml.write("sensors 0 87 64 215400")
    shown = until(lambda: client.ask("status")["gpus"][0].get("sensors"))
    assert shown == {"utilization": 0.87, "temperature_c": 64.0, "power_w": 215.4}


def test_an_error_code_is_unknown_blocks_and_recovers(client: WireClient, nvml: NvmlStub) -> None:
    assert client.ask("subscribe")["ok"]
    nvml.write("error memory 15")
    event(client, "probe_failed", lambda told: "GPU is lost" in told["reason"])
    assert client.acquire("next", GIB)["state"] == "queued"
    nvml.write()
    event(client, "probe_ok")
    client.push("granted")


@pytest.mark.parametrize(("left", "verdict"), [(0, "verified"), (2 * GIB, "residue")])
def test_where_bytes_per_process_are_na_the_total_decides(
    client: WireClient, nvml: NvmlStub, left: int, verdict: str
) -> None:
    """WSL2 and WDDM: processes are listed, their bytes are not. What stays is charged to who let
    go, as nobody else can be named."""
    assert client.ask("subscribe")["ok"]
    on = granted(client, "holder", 5 * GIB)
    nvml.gpu(5 * GIB)
    nvml.write(f"process 0 compute {ME} na")
    assert client.ask("ready", **on)["ok"]
    until_read(client, 5 * GIB)
    let_go(client, nvml, on, left, f"process 0 compute {ME} na")
    said = event(client, "verified")
    assert (said["verdict"], said["culprits"]) == (verdict, [])
    assert client.ask("status")["gpus"][0]["charged_bytes"] == left


def test_the_daemon_makes_no_cuda_context(daemon: ArbiterProcess) -> None:
    """llama.cpp#20582: a manager that asks CUDA for free memory eats 120-550 MB of every GPU
    itself."""
    mapped = {
        Path(line.split()[-1]).name
        for line in Path(f"/proc/{daemon.pid}/maps").read_text().splitlines()
    }
    assert "libnvidia-ml.so.1" in mapped
    assert not [name for name in mapped if name.startswith(("libcuda", "libcudart", "libtorch"))]
