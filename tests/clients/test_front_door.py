"""`vram_arbiter` as its users see it: what it exports, what importing costs, one surface for both
clients."""

import ast
import inspect
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

import vram_arbiter
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter import (
    AsyncClient,
    AsyncForeignUse,
    AsyncLease,
    AsyncUse,
    BadRequest,
    Client,
    Footprint,
    ForeignUse,
    Handlers,
    Lease,
    Use,
    VramError,
)
from vram_arbiter.schemas.defaults import GIB, RESIDUE_BYTES

TWINS = [(Client, AsyncClient), (Lease, AsyncLease), (Use, AsyncUse), (ForeignUse, AsyncForeignUse)]


def surface(kind: type) -> dict[str, str]:
    """Public members: a method with its parameters as text, or the word `property`."""
    found: dict[str, str] = {}
    for name, member in inspect.getmembers(kind):
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, property):
            found[name] = "property"
        elif callable(member):
            found[name] = parameters(member)
    return found


def parameters(function: Callable[..., object]) -> str:
    """Names, kinds, defaults and types; the types of the two surfaces differ by the word Async
    only."""
    listed = list(inspect.signature(function).parameters.values())[1:]
    return re.sub(r"vram_arbiter\.[a-z_.]+|Async", "", ", ".join(str(one) for one in listed))


@pytest.mark.parametrize(("blocking", "asynchronous"), TWINS, ids=lambda kind: kind.__name__)
def test_both_clients_have_the_same_surface(blocking: type, asynchronous: type) -> None:
    """Nine methods of the async client were missing in the blocking one."""
    ours, theirs = surface(blocking), surface(asynchronous)
    ours["__init__"] = theirs["__init__"] = ""  # only clients are made by hand; compared below
    assert ours == theirs
    assert parameters(Client.__init__) == parameters(AsyncClient.__init__)


def test_a_method_that_only_one_of_them_has_is_found() -> None:
    """The check can fail."""

    class More(Client):
        def extra(self) -> None: ...

    assert surface(More).keys() - surface(AsyncClient).keys() == {"extra"}


def test_every_exported_name_is_there() -> None:
    for name in vram_arbiter.__all__:
        assert inspect.isclass(getattr(vram_arbiter, name)), name
    assert set(vram_arbiter.__all__) <= set(dir(vram_arbiter))
    with pytest.raises(AttributeError, match="has no attribute 'Klient'"):
        _ = vram_arbiter.Klient


def test_the_names_for_type_checkers_are_the_exported_ones() -> None:
    tree = ast.parse(inspect.getsource(vram_arbiter))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    typed = [
        alias.name
        for node in ast.walk(block)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert sorted(typed) == sorted(vram_arbiter.__all__)


def test_importing_the_package_loads_nothing_else() -> None:
    look = (
        "import sys; before = set(sys.modules); import vram_arbiter, json; "
        "print(json.dumps(sorted(set(sys.modules) - before)))"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout)}
    assert loaded & {"anyio", "asyncio", "zmq", "pydantic", "msgpack"} == set()
    assert [name for name in json.loads(done.stdout) if name.startswith("vram_arbiter.")] == []


def test_a_handler_is_given_once() -> None:
    with pytest.raises(TypeError, match="'unload' was given twice"):
        Handlers(unload=print).merged(unload=print)


@pytest.mark.e2e
class TestThreads:
    """The blocking client against a real daemon."""

    def test_the_example_of_the_design_runs(self, arbiter_daemon: ArbiterProcess) -> None:
        """A plain function as `unload` ended in a traceback."""
        did: list[str] = []
        with Client("detector", endpoint=arbiter_daemon.endpoint) as arbiter:
            with arbiter.lease(
                vram="5.3GB", model="owlv2", unload=lambda: did.append("unload")
            ) as lease:
                assert (lease.state, lease.spec.consumer) == ("loading", "detector")
                assert lease.spec.footprint == Footprint(
                    load_peak_bytes=5_300_000_000, steady_bytes=5_300_000_000
                )
                with lease.use("detect"):  # the first use marks the lease ready
                    assert arbiter.leases[0].state == lease.state == "held"
                    assert lease.uses == 1
            assert (lease.state, did) == ("gone", ["unload"])

    def test_handlers_are_plain_or_coroutine_functions(
        self, arbiter_daemon: ArbiterProcess
    ) -> None:
        threads: dict[str, str] = {}

        def note(what: str) -> None:
            threads[what] = threading.current_thread().name

        async def unload() -> None:
            note("unload")

        handlers = Handlers[Lease](
            unload=unload,
            on_revoke=lambda lease, eviction: note(f"revoke for {eviction.by} of {lease.lease_id}"),
        )
        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            first = arbiter.acquire(vram="5GiB", handlers=handlers, min_residency_s=0.0)
            first.ready()
            arbiter.acquire(vram=5 * GIB, consumer="other").release()
            first.wait_gone()
        assert threads.pop("unload") == "vram-arbiter-client"
        ((what, thread),) = threads.items()
        assert what == f"revoke for other of {first.lease_id}"
        assert thread != "vram-arbiter-client"

    def test_a_restore_that_fails_gives_the_lease_up(self, arbiter_daemon: ArbiterProcess) -> None:
        """The lease stayed `loading`, and no other model could be loaded."""

        def restore(_: Lease) -> None:
            raise RuntimeError("the file is gone")

        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            first = arbiter.acquire(vram="5GiB", standby=True, restore=restore, min_residency_s=0.0)
            first.ready()
            arbiter.acquire(vram="5GiB", consumer="other").release()
            first.wait_gone()
            assert first.given_up

    def test_a_restore_that_returns_marks_the_lease_ready(
        self, arbiter_daemon: ArbiterProcess
    ) -> None:
        began, loaded = threading.Event(), threading.Event()

        def restore(_: Lease) -> None:
            began.set()
            assert loaded.wait(PATIENCE_S)

        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            first = arbiter.acquire(vram="5GiB", standby=True, restore=restore, min_residency_s=0.0)
            first.ready()
            arbiter.acquire(vram="5GiB", consumer="other").release()
            assert began.wait(PATIENCE_S)
            assert first.state == "loading"
            threading.Timer(0.05, loaded.set).start()
            with first.use():  # waits until it is loaded
                assert loaded.is_set()
            assert first.state == "held"

    def test_a_call_that_waits_ends_with_the_client(self, arbiter_daemon: ArbiterProcess) -> None:
        """A thread that waited for an event kept the client's thread, and so its end, for ever."""
        ended: list[str] = []

        def follow(arbiter: Client) -> None:
            try:
                for _ in arbiter.subscribe():
                    following.set()
            except VramError as error:
                ended.append(error.code)

        following = threading.Event()
        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            thread = threading.Thread(target=follow, args=(arbiter,))
            thread.start()
            while not following.wait(0.05):
                arbiter.acquire(vram="1GiB").release()
        thread.join(PATIENCE_S)
        assert ended

    @pytest.mark.parametrize(
        ("wanted", "said"),
        [
            ({}, "neither a spec nor `vram`"),
            ({"vram": "abc"}, "not a size: 'abc'"),
            ({"vram": "1GiB", "standy": True}, "standy: Unexpected keyword argument"),
            ({"vram": "1GiB", "priority": 101}, "priority: .* got 101"),
        ],
    )
    def test_what_is_not_a_spec_is_refused(
        self, arbiter_daemon: ArbiterProcess, wanted: dict[str, object], said: str
    ) -> None:
        with (
            Client("t", endpoint=arbiter_daemon.endpoint) as arbiter,
            pytest.raises(BadRequest, match=said),
        ):
            arbiter.acquire(**wanted)  # type: ignore[arg-type]  # that is the point

    def test_a_small_model_leaves_no_more_than_it_took(
        self, arbiter_daemon: ArbiterProcess
    ) -> None:
        with Client("t", endpoint=arbiter_daemon.endpoint) as arbiter:
            lease = arbiter.acquire(vram=RESIDUE_BYTES // 2)
            assert lease.spec.footprint.residue_bytes == RESIDUE_BYTES // 2
