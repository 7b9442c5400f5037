"""Crashes of the daemon, corrupt and unwritable journals, hanging probes: leases survive, and
nothing is granted on a guess."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.process import ArbiterProcess, Make
from tests.support.running import Running, running
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import TTL_S, WireClient
from vram_arbiter.arbiter.host.journal import Journal
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.procfs import boot_id, start_ticks
from vram_arbiter.testing.gpu import FakeGpu

pytestmark = pytest.mark.e2e


def occupy(arbiter: ArbiterProcess, size: int) -> None:
    """Put bytes of this very process on the simulated GPU."""
    ticks = start_ticks(os.getpid())
    assert ticks is not None
    key = ProcessKey(os.getpid(), ticks)
    process = fakegpu.ProcessFile(
        pid=key.pid, start_ticks=key.start_ticks, name="test", allocated_bytes=size
    )
    path = arbiter.gpu_folder / fakegpu.file_name(key)
    temporary = path.with_name(".new")
    temporary.write_text(process.model_dump_json())
    temporary.rename(path)


def hold(client: WireClient, arbiter: ArbiterProcess, name: str, size: int) -> dict[str, Any]:
    """Acquire, load, ready: the lease's id and token."""
    lease = client.granted(name, size)
    occupy(arbiter, size)
    on = {"lease_id": lease["lease_id"], "token": lease["token"]}
    assert client.ask("ready", **on, measured_bytes=size)["ok"]
    client.ask("ping")  # answered after the record of `ready` is written
    return on


def reattach(client: WireClient, on: dict[str, Any], name: str, size: int) -> dict[str, Any]:
    spec = {"consumer": name, "model_id": name, "ttl_s": TTL_S,
            "footprint": {"load_peak_bytes": size, "steady_bytes": size,
            "residue_bytes": 0}}  # fmt: skip
    reply = client.ask(
        "reattach", leases=[{**on, "spec": spec, "state": "held", "measured_bytes": size}]
    )
    assert reply["ok"], reply
    answer = reply["leases"][0]
    assert isinstance(answer, dict)
    return answer


RUNNER = """
import sys
from vram_arbiter.clients.sync import Client
lease_id, epoch, counter = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
with Client(name="runner") as client, client.use(lease_id, (epoch, counter), "goal") as use:
    print("in use", flush=True)
    sys.stdin.readline()
    print(use.lost, flush=True)
"""


@contextlib.contextmanager
def runner_on(arbiter: ArbiterProcess, on: dict[str, Any]) -> Iterator[Running]:
    """Another process, by the product's own client, uses the lease whose token it was told. It ends
    its use with its input."""
    words = [RUNNER, on["lease_id"], *map(str, on["token"])]
    with running("script", words, arbiter.environ) as runner:
        assert runner.line() == "in use"
        yield runner


@pytest.mark.parametrize("end", ["it goes on", "it dies"])
def test_a_user_that_is_stopped_while_the_daemon_restarts_keeps_the_holder(
    make_arbiter: Make, end: str
) -> None:
    """Regression: nothing but its own client knew of the use, and the holder was sent away in the
    middle of a grab."""
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        on = hold(client.hello(), arbiter, "sidecar", 5 * GIB)
        with runner_on(arbiter, on) as runner:
            runner.process.send_signal(signal.SIGSTOP)
            arbiter.kill()
            arbiter.start()
            with WireClient(arbiter.endpoint) as sidecar:
                answer = reattach(sidecar.hello(), on, "sidecar", 5 * GIB)
                assert (answer["kept"], answer["lease"]["uses"]) == (True, 1)
                waiting = sidecar.acquire("waiter", 5 * GIB, priority=100)
                assert waiting["state"] == "queued"
                assert sidecar.push("revoke")["uses"] == 1
                refused = sidecar.ask("unloading", **on)["error"]
                assert (refused["code"], refused["details"]["uses"]) == ("bad_state", 1)
                if end == "it dies":
                    runner.process.kill()  # the kernel tells, also of one that is stopped
                else:
                    assert sidecar.ask("subscribe")["ok"]
                    runner.process.send_signal(signal.SIGCONT)
                    again = sidecar.push(
                        "event",
                        timeout_s=30.0,
                        where=lambda push: push["event"]["kind"] == "use_began",
                    )
                    assert again["event"]["resumed"]
                    runner.tell("end\n")
                    assert runner.line() == "None", "its use was not lost"
                assert sidecar.push("revoke", where=lambda push: push["uses"] == 0)
                assert sidecar.ask("unloading", **on)["ok"]
                occupy(arbiter, 0)
                assert sidecar.ask("release", **on)["ok"]
                assert sidecar.push("granted")["lease"]["lease_id"] == waiting["lease"]["lease_id"]


def leases_of(client: WireClient) -> list[tuple[str, str, list[int] | None]]:
    return [
        (lease["consumer"], lease["state"], lease["token"])
        for lease in client.ask("status")["leases"]
    ]


def test_leases_survive_kill_9_of_the_daemon(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        on = hold(client.hello(), arbiter, "holder", 5 * GIB)
    arbiter.kill()
    arbiter.start()
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        status = client.ask("status")
        assert status["phase"] == "recovering"
        assert status["epoch"] > on["token"][0]
        assert leases_of(client) == [("holder", "held", on["token"])]
        waiting = client.acquire("waiter", 5 * GIB)
        assert waiting["state"] == "queued", "nothing is granted before the holder is accounted for"
        assert reattach(client, on, "holder", 5 * GIB)["kept"]
        assert client.ask("status")["phase"] == "serving"
        revoke = client.push("revoke")
        assert (revoke["lease_id"], revoke["token"]) == (on["lease_id"], on["token"])
        assert client.ask("unloading", **on)["ok"]
        occupy(arbiter, 0)
        assert client.ask("release", **on)["ok"]
        granted = client.push("granted")["lease"]
        assert granted["lease_id"] == waiting["lease"]["lease_id"]
        assert granted["token"] > on["token"], "tokens grow across restarts"


def test_leases_survive_an_orderly_restart_and_go_with_their_dead_holder(
    make_arbiter: Make,
) -> None:
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        hold(client, arbiter, "holder", 5 * GIB)
    assert arbiter.stop() == 0
    journal = Journal.open(arbiter.state, boot_id())  # its holder dies unseen
    journal.apply(
        [(key, {**record, "start_ticks": 1}) for key, record in journal.opened.records.items()]
    )
    journal.close()
    for file in arbiter.gpu_folder.glob(f"{os.getpid()}-*.json"):
        file.unlink()
    arbiter.start()
    with WireClient(arbiter.endpoint) as client:
        assert client.hello().granted("next", 7 * GIB)["state"] == "loading"


def test_a_corrupt_journal_is_reported_and_the_holder_is_believed(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        on = hold(client.hello(), arbiter, "holder", 5 * GIB)
    arbiter.kill()
    path = arbiter.state / "journal.sqlite"
    path.write_bytes(os.urandom(20_000))
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    arbiter.start()
    aside = path.with_name(f"{path.name}.corrupt-1")
    assert aside.exists()
    until(lambda: "journal_put_aside" in arbiter.log)  # a thread writes it
    with WireClient(arbiter.endpoint) as client:
        client.hello()
        status = client.ask("status")
        assert status["phase"] == "recovering"
        assert status["epoch"] > on["token"][0]
        assert str(aside) in status["problems"][0]
        kinds = [event["kind"] for event in client.ask("history")["events"]]
        assert "journal_put_aside" in kinds
        assert client.acquire("waiter", GIB)["state"] == "queued", (
            "somebody may hold what nobody remembers"
        )
        assert reattach(client, on, "holder", 5 * GIB)["kept"]
        assert ("holder", "held", on["token"]) in leases_of(client)


def test_a_measured_footprint_is_charged_after_a_restart_and_a_reboot(make_arbiter: Make) -> None:
    arbiter = make_arbiter().start()
    with WireClient(arbiter.endpoint) as client:
        on = hold(client.hello(), arbiter, "holder", GIB)
        assert client.ask("oom", **on, requested_bytes=2 * GIB, allocated_bytes=GIB)["ok"]
        assert client.ask("bye")["ok"]
    assert arbiter.stop() == 0
    Journal.open(arbiter.state, "an earlier boot").close()
    arbiter.start()
    with WireClient(arbiter.endpoint) as client:
        lease = client.hello().granted("holder", GIB, nonce="again")
        assert lease["charge_bytes"] == 3 * GIB
    assert arbiter.stop() == 0


def hang(arbiter: ArbiterProcess) -> None:
    """Readings of the simulated GPU hang from now on."""
    FakeGpu(arbiter.gpu_folder).edit(probe="hang")


def test_a_hanging_driver_does_not_hold_up_the_stop(make_arbiter: Make) -> None:
    arbiter = make_arbiter(config="probe:\n  deadline_s: 0.2\n").start()
    with WireClient(arbiter.endpoint) as watcher:
        watcher.hello("watcher").ask("subscribe")
        hang(arbiter)
        watcher.push("event", where=lambda push: push["event"]["kind"] == "probe_failed")
        assert arbiter.stop() == 0


def test_status_of_an_idle_daemon_reads_the_gpu_before_it_answers(make_arbiter: Make) -> None:
    """After idleness `status` showed 5.4 GiB of a process without a lease as free memory, for up to
    11 minutes."""
    config = "probe:\n  period_s: 3600\n  sample_max_age_s: 0.05\n"
    arbiter = make_arbiter(config=config).start()
    with contextlib.closing(WireClient(arbiter.endpoint)) as client:
        client.hello()
        assert client.ask("status")["gpus"][0]["stowaway_bytes"] == 0
        occupy(arbiter, 5 * GIB)
        deadline = time.monotonic() + PATIENCE_S
        while not (gpu := client.ask("status")["gpus"][0])["stowaway_bytes"]:
            assert time.monotonic() < deadline, f"an old reading is shown: {gpu}"
        assert (gpu["stowaway_bytes"], gpu["measured_used_bytes"]) == (5 * GIB, 5 * GIB)
