"""Leased classes as plain objects against a real daemon; Ray adds processes alone."""

import asyncio
import gc
import inspect
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import pytest

from tests.support.fakegpu_check import check_log
from tests.support.leases import Spec
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S, play, until
from vram_arbiter.clients import lease
from vram_arbiter.clients.ray import Refused, idempotent, leased
from vram_arbiter.clients.ray.refusals import refuse_options
from vram_arbiter.clients.ray.residency import Residency
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import BadRequest, LeaseRevoking, WaitTimeout
from vram_arbiter.testing.gpu import FakeGpu
from vram_arbiter.testing.timeline import Timeline


class Model:
    """Puts its bytes on the simulated GPU; `go` lets `wait` end."""

    folder: Any
    lease: Any
    fails = False

    def __init__(self) -> None:
        self.begun, self.go = threading.Event(), threading.Event()
        self.loads = self.unloads = 0

    def load(self) -> None:
        if self.fails:
            raise RuntimeError("no weights")
        self.loads += 1
        self.warmed = self.act(self.loads)
        FakeGpu(self.folder, "model").allocate("5GiB")

    def unload(self) -> None:
        self.unloads += 1
        FakeGpu(self.folder, "model").free()

    def act(self, x: int) -> int:
        return x

    def nested(self, x: int) -> int:
        return self.act(x) + 1

    def wait(self) -> str:
        self.begun.set()
        assert self.go.wait(PATIENCE_S)
        return "held"

    def refused_inside(self) -> None:
        self.loads += 10
        raise LeaseRevoking("of another lease")

    async def later(self, x: int) -> int:
        await asyncio.sleep(0)
        return x


Make = Callable[..., Any]


@pytest.fixture
def make_policy(arbiter_daemon: ArbiterProcess, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """`make(wait_s=…)`: an object of a leased class of 5 GiB of 8."""
    monkeypatch.setenv("VRAM_ARBITER_ENDPOINT", arbiter_daemon.endpoint)

    def make_policy(**options: Any) -> Any:
        class Policy(Model):
            folder = arbiter_daemon.gpu_folder

        return leased(vram="5GiB", model="pi0", **options)(Policy)()

    yield make_policy
    gc.collect()
    report = check_log((arbiter_daemon.gpu_folder / "log.jsonl").read_text())
    assert (report.problems, report.oom_events, report.peak_bytes) == ([], 0, 5 * GIB)


@pytest.mark.e2e
def test_the_first_call_loads_and_calls_that_follow_share_uses(
    make_policy: Make, arbiter_daemon: ArbiterProcess
) -> None:
    model = make_policy()
    assert model.loads == 0
    assert [model.act(x) for x in range(200)] == list(range(200))
    assert (model.loads, model.warmed) == (1, 1)
    assert model.lease.gpu.startswith("GPU-fake-")
    assert 1 <= len(Timeline(arbiter_daemon).events("use_began")) < 200
    until(lambda: model.lease.uses == 0)


@pytest.mark.e2e
def test_evicted_between_calls_and_never_inside(
    make_policy: Make, client: Client, spec: Spec
) -> None:
    model = make_policy()
    with ThreadPoolExecutor(2) as pool:
        inside = pool.submit(model.wait)
        assert model.begun.wait(PATIENCE_S)
        waiting = pool.submit(client.acquire, spec("other", 5))
        until(lambda: model.lease.revoking)
        assert model.unloads == 0
        model.go.set()
        assert inside.result(PATIENCE_S) == "held"
        other = waiting.result(PATIENCE_S)
    assert model.unloads == 1
    again = threading.Thread(target=other.release)
    again.start()
    assert model.nested(1) == 2
    again.join()
    assert model.loads == 2


@pytest.mark.e2e
def test_a_revoke_that_is_withdrawn_keeps_the_model(
    make_policy: Make, client: Client, spec: Spec
) -> None:
    """A call that waited for the end of the lease never began."""
    model = make_policy()
    with ThreadPoolExecutor(3) as pool:
        inside = pool.submit(model.wait)
        assert model.begun.wait(PATIENCE_S)
        waiting = pool.submit(client.acquire, spec("other", 5), 3.0)
        until(lambda: model.lease.revoking)
        beside = pool.submit(model.act, 7)
        with pytest.raises(WaitTimeout):
            waiting.result(PATIENCE_S)
        assert beside.result(PATIENCE_S) == 7
        model.go.set()
        assert inside.result(PATIENCE_S) == "held"
    assert (model.loads, model.unloads) == (1, 0)


@pytest.mark.e2e
def test_a_body_is_never_run_again(make_policy: Make) -> None:
    """A refusal of another lease inside the body is the caller's."""
    model = make_policy()
    with pytest.raises(LeaseRevoking, match="of another lease"):
        model.refused_inside()
    assert model.loads == 11


@pytest.mark.e2e
def test_a_load_that_fails_gives_the_lease_up(make_policy: Make, client: Client) -> None:
    model = make_policy()
    model.fails = True
    with pytest.raises(RuntimeError, match="no weights"):
        model.act(1)
    until(lambda: client.status().leases == ())
    model.fails = False
    assert model.act(1) == 1


@pytest.mark.e2e
def test_a_wait_that_ends_is_refused_to_all_that_waited(
    make_policy: Make, client: Client, spec: Spec, arbiter_daemon: ArbiterProcess
) -> None:
    """Each waited for a time limit of its own, one after the other."""
    model = make_policy(wait_s=1.0)
    with client.lease(spec("other", 5, evictable=False)) as pinned, ThreadPoolExecutor(4) as pool:
        pinned.ready()
        waiting = [pool.submit(model.act, 1) for _ in range(4)]
        for one in waiting:
            with pytest.raises(Refused, match="not granted here") as refused:
                one.result(PATIENCE_S)
            assert refused.value.details["code"] == "wait_timeout"
        assert len(Timeline(arbiter_daemon).events("denied")) == 1
    assert model.act(1) == 1


@pytest.mark.e2e
def test_the_end_of_the_object_gives_the_lease_back(make_policy: Make, client: Client) -> None:
    model = make_policy()
    model.act(1)
    del model
    gc.collect()
    until(lambda: client.status().leases == ())


@pytest.mark.e2e
def test_coroutines_and_one_that_is_canceled_while_it_waits(
    make_policy: Make, client: Client, spec: Spec
) -> None:
    """A use that began for a caller that was gone was never ended."""
    model = make_policy()

    async def story() -> None:
        assert await asyncio.gather(*(model.later(x) for x in range(20))) == list(range(20))
        other = await asyncio.to_thread(client.acquire, spec("other", 5, evictable=False))
        other.ready()
        waiting = asyncio.create_task(model.later(1))
        await asyncio.to_thread(until, lambda: client.status().totals.waiting)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await asyncio.to_thread(other.give_up)

    play(story)
    until(lambda: model.loads == 2)
    until(lambda: model.lease.uses == 0)


def test_a_coroutine_uses_what_is_loaded_without_a_thread(
    make_policy: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way to a thread and back was most of what a lease added to a coroutine's call."""
    monkeypatch.setattr(lease, "PAUSE_S", 0.0)
    model = make_policy()

    async def story() -> None:
        assert await model.later(1) == 1
        await asyncio.to_thread(until, lambda: model.lease.uses == 0)
        monkeypatch.delattr(Residency, "_entered")
        assert await model.later(2) == 2

    play(story)
    until(lambda: model.lease.uses == 0)


@pytest.mark.heavy
@pytest.mark.e2e
def test_a_task_runs_inside_a_lease_of_its_own(
    make_policy: Make, arbiter_daemon: ArbiterProcess, client: Client
) -> None:
    """Ray runs the function; `make` says where the arbiter is."""
    ray: Any = pytest.importorskip("ray")
    make_policy().act(1)  # its 5 of 8 GiB leave for the task

    def job(x: int) -> int:
        return x + int(client.status().leases[-1].consumer.startswith("job-"))

    task = leased(vram="5GiB", model="job")(ray.remote(max_calls=1)(job))
    assert task._function(41) == 42
    for options, told in (
        ({"num_cpus": 1}, "job is a task without max_calls=1"),
        ({"num_gpus": 1}, "'num_gpus' stands beside"),
        ({"max_calls": 1, "resources": {"vram_bytes": 1}}, "'vram_bytes' stands beside"),
    ):
        with pytest.raises(BadRequest, match=told):
            leased(vram="5GiB", model="job")(ray.remote(**options)(job))


@pytest.mark.heavy
def test_gpus_and_bytes_in_options_are_refused_before_ray_waits_for_them() -> None:
    """Ray waited for ever for a node with a GPU; none announces one to it."""
    ray: Any = pytest.importorskip("ray")

    def job() -> None: ...

    class Policy(Model): ...

    lease = leased(vram="5GiB", model="m")
    policy, task = lease(Policy), lease(ray.remote(max_calls=1)(job))
    for beside in ({"num_gpus": 1}, {"accelerator_type": "A100"}, {"resources": {"vram": 1}}):
        for asked in (
            ray.remote(policy).options(**beside),
            ray.remote(**beside)(policy),
            task.options(**beside),
        ):
            with pytest.raises(BadRequest, match="beside @leased"):
                asked.remote()
    for sent in (ray.remote(policy), task):  # a class of __main__ goes by value
        with pytest.raises(BadRequest, match="beside @leased"):
            ray.cloudpickle.loads(ray.cloudpickle.dumps(sent)).options(num_gpus=1).remote()


@pytest.mark.heavy
def test_a_class_that_is_an_actor_already_is_refused() -> None:
    """It was an AttributeError; tasks are leased in that order."""
    ray: Any = pytest.importorskip("ray")
    with pytest.raises(BadRequest, match="Model is an actor of Ray already"):
        leased(vram="5GiB", model="m")(ray.remote(Model))


def test_a_leased_class_keeps_what_its_subclasses_go_through() -> None:
    class Named(Model):
        names: ClassVar[list[str]] = []

        def __init_subclass__(cls, **named: Any) -> None:
            super().__init_subclass__(**named)
            cls.names.append(cls.__name__)

    class Sub(leased(vram="5GiB", model="m")(Named)): ...  # type: ignore[misc]

    assert Named.names == ["Sub"]


def test_what_cannot_be_leased_is_refused_by_name() -> None:
    class Bare:
        def act(self) -> None: ...

    class Late(Model):
        async def load(self) -> None: ...  # type: ignore[override]

    class Stream(Model):
        def tokens(self) -> Iterator[str]:
            yield ""

    def task() -> None: ...

    for made, told in (
        (Bare, "Bare.load is not a plain method"),
        (Late, "Late.load is not a plain method"),
        (Stream, "Stream.tokens yields"),
        (task, "task is a task without max_calls=1"),
    ):
        with pytest.raises(BadRequest, match=told):
            leased(vram="5GiB", model="pi0")(made)
    with pytest.raises(BadRequest, match="5GiB"):
        leased(vram="5", model="pi0")(Model)


def test_bytes_and_gpus_beside_a_lease_are_refused_by_name() -> None:
    refuse_options({"num_cpus": 1, "num_gpus": 0, "resources": {"disk": 1, "vram_arbiter": 0.001}})
    for name in ("gpu_memory", "vram_bytes"):
        with pytest.raises(BadRequest, match=name):
            refuse_options({"resources": {name: 1}})


def test_methods_are_functions_to_their_core() -> None:
    """Ray puts a signature on the innermost one; it refused classes without `__init__`."""

    class Bare:
        def load(self) -> None: ...

        def unload(self) -> None: ...

    for made in (Bare, Model):
        kept = type(made.__name__, (made,), {})
        assert inspect.isfunction(inspect.unwrap(leased(vram="5GiB", model="m")(kept).__init__))


def test_only_idempotent_methods_are_sent_again() -> None:
    class Policy(Model):
        @idempotent
        def act(self, x: int) -> int:
            return x

    made = leased(vram="5GiB", model="pi0")(Policy)
    retries = {
        name: vars(getattr(made, name))["__ray_max_task_retries__"] for name in ("act", "wait")
    }
    assert retries == {"act": -1, "wait": 0}
    assert made.leased.need_bytes == 5 * GIB  # type: ignore[attr-defined]
    assert made.leased.model == "pi0"  # type: ignore[attr-defined]
