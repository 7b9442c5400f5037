"""`@leased`: a class whose public methods run with its model on the GPU, under a lease of the
arbiter of the box that it runs on.

    @leased(vram="5GiB", model="pi0", wait_s=30)
    class Policy:
        def load(self): self.net = load_pi0(self.lease.gpu)  # after the grant
        def unload(self): self.net = None                    # between calls, for another model
        def episode(self, seed): return play(self.net, seed)

It needs no Ray: a plain object of the class does the same in its own process.
"""

import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, Final, cast

from vram_arbiter.clients._spec import Vram, lease_spec
from vram_arbiter.clients.cuda import visible
from vram_arbiter.clients.ray.refusals import CREATE, guard, refuse_options
from vram_arbiter.clients.ray.residency import Residency
from vram_arbiter.clients.sync import Lease
from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.wire.spec import LeaseSpec

WAIT_S: Final = 30.0
_RETRIES = "__ray_max_task_retries__"
"""What `ray.method(max_task_retries=…)` puts on a method."""


@dataclass(frozen=True, slots=True)
class LeasedSpec:
    """What `@leased` says of a class. `lease` names the class as its consumer."""

    lease: LeaseSpec
    wait_s: float

    @property
    def need_bytes(self) -> int:
        """What has to be free for it to load."""
        return self.lease.footprint.load_peak_bytes

    @property
    def model(self) -> str:
        return self.lease.model


def leased[T](
    vram: Vram, model: str, wait_s: float = WAIT_S, priority: int | None = None
) -> Callable[[T], T]:
    """Decorate a class, or a task of Ray with `max_calls=1`, whose process keeps no GPU context.

    Args:
        vram: bytes that the model needs, such as `5GiB`.
        model: model id; calls go to boxes where it is resident first.
        wait_s: longest wait for a grant in seconds; then the call raises Refused.
        priority: of the lease; None takes the default.

    Raises: BadRequest for a size, class or task that cannot be leased.
    """

    def decorate(made: T) -> T:
        decorated: Any = made
        if metadata := getattr(made, "__ray_metadata__", None):
            raise BadRequest(
                f"{metadata.class_name} is an actor of Ray already",
                hint="write @ray.remote above @leased(…)",
            )
        name = getattr(decorated, "__name__", None) or decorated._function_name.rpartition(".")[2]
        given = {} if priority is None else {"priority": priority}
        spec = LeasedSpec(lease_spec(None, name, vram, model, given), wait_s)
        of_kind = _leased_class if inspect.isclass(made) else _leased_task
        return cast(T, of_kind(decorated, spec))

    return decorate


def idempotent[F: Callable[..., object]](method: F) -> F:
    """Let Ray send calls of a method again after its actor died: running twice does no harm."""
    setattr(method, _RETRIES, -1)
    return method


def hold(actor: Any) -> None:
    """Load a leased actor's model now: `actor.__ray_call__.remote(hold)`. Raises Refused."""
    with actor._residency.call("hold"):
        pass


# -- classes
def _leased_class(made: Any, spec: LeasedSpec) -> Any:
    methods = {
        name: method
        for name, method in inspect.getmembers_static(made, inspect.isfunction)
        if not name.startswith("_")
    }
    for name in ("load", "unload"):
        if name not in methods or inspect.iscoroutinefunction(methods[name]):
            raise BadRequest(
                f"{made.__name__}.{name} is not a plain method",
                hint="a leased class loads its model in `load` and frees it in `unload`",
            )
        del methods[name]
    for name, method in methods.items():
        setattr(made, name, _inside_a_use(made, method))
    begin = made.__init__

    def init(self: Any, *arguments: Any, **named: Any) -> None:
        self._residency = Residency(self, spec.lease, spec.wait_s)
        begin(self, *arguments, **named)

    own = vars(made).get("__init_subclass__")

    def init_subclass(cls: type[Any], /, **named: Any) -> None:
        (own.__get__(None, cls) if own else super(made, cls).__init_subclass__)(**named)
        if hasattr(cls, CREATE):  # Ray's, which takes the options
            guard(cls)

    # Ray signs the innermost function, and object's is none
    made.__init__ = wraps(begin)(init) if inspect.isfunction(begin) else init
    made.__init_subclass__ = classmethod(init_subclass)
    made.leased = spec
    return made


def _inside_a_use(made: type, method: Any) -> Any:
    """Return the method, called with the model loaded and inside a use."""
    name = method.__name__
    if inspect.isgeneratorfunction(method) or inspect.isasyncgenfunction(method):
        raise BadRequest(
            f"{made.__name__}.{name} yields, and a use is a call",
            hint="return a list, or begin its name with an underscore",
        )
    if inspect.iscoroutinefunction(method):

        @wraps(method)
        async def call(self: Any, *arguments: Any, **named: Any) -> Any:
            if self._residency.within:
                return await method(self, *arguments, **named)
            async with self._residency.acall(name):
                return await method(self, *arguments, **named)

    else:

        @wraps(method)
        def call(self: Any, *arguments: Any, **named: Any) -> Any:
            if self._residency.within:
                return method(self, *arguments, **named)
            with self._residency.call(name):
                return method(self, *arguments, **named)

    vars(call).setdefault(_RETRIES, 0)
    return call


# -- tasks
class _Job:
    """Owner of a task's lease; the task loads for itself."""

    lease: Lease

    def load(self) -> None: ...

    def unload(self) -> None: ...


def _leased_task(made: Any, spec: LeasedSpec) -> Any:
    options = getattr(made, "_default_options", {})
    if options.get("max_calls") != 1:
        raise BadRequest(
            f"{spec.lease.consumer} is a task without max_calls=1: its process would keep a GPU "
            "context without a lease",
            hint="write @leased(…) above @ray.remote(max_calls=1)",
        )
    refuse_options(options)
    import ray

    function = made._function

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        job = _Job()
        with Residency(job, spec.lease, spec.wait_s).call(""):
            os.environ.update(visible(job.lease.gpu, os.environ))
            return function(*arguments, **named)

    task = ray.remote(**options)(call)
    guard(task)
    return task
