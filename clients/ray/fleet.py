"""The boxes of a Ray cluster, as one process sees them: what their arbiters say, and actors placed
by it. Ray runs and restarts actors; each box's arbiter decides what its GPU holds.
"""

import contextlib
import logging
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any, Final, Self

from vram_arbiter.clients.ray import agent, placement
from vram_arbiter.clients.ray.leased import LeasedSpec, hold
from vram_arbiter.clients.ray.mapping import Result, map_results
from vram_arbiter.clients.ray.placement import Ranked, View
from vram_arbiter.clients.ray.refusals import (
    MARKER,
    refuse_bytes,
    refuse_open,
    refuse_options,
    token_auth,
)
from vram_arbiter.clients.ray.residency import Refused
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadRequest, ConfigError
from vram_arbiter.schemas.plain import JsonMap, JsonObject, Message
from vram_arbiter.schemas.runtime.extras import need

ANSWER_S: Final = 1.0
"""How long agents are waited for. Views of 1,000 boxes take half of it."""
START_S: Final = 60.0
"""An agent or actor starts a Python that imports Ray: up to 10 s on a machine with other work."""
CONNECT_S: Final = 3.0
SLIVER: Final = 0.001
"""Of a node's marker, which any number of actors share."""
log = logging.getLogger(__name__)


class Fleet:
    """Boxes of the cluster that `ray.init` connected this process to.

        ray.init(address="auto")
        with Fleet() as fleet:
            actors = fleet.spread(Policy, per_node=2)
            for result in fleet.map(actors, "episode", range(1000), out=out, deadline_s=600):
                ...

    A box is a node that was started with the resource `vram_arbiter`. The agents that entering
    starts on them stay for other drivers. Its methods are for one thread.
    """

    def __init__(self) -> None:
        self._rng = Random()
        self._agents: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Start the agents that are missing, and wait for answers: START_S at most.

        Raises: ConfigError without Ray, a connection or a box; NotPermitted for a cluster that is
            open to its network; BadRequest for nodes that announce bytes of GPUs to Ray.
        """
        need("a fleet", "ray", extra="ray")
        import ray

        if not ray.is_initialized():
            raise ConfigError("no connection to Ray", hint='call ray.init(address="auto") first')
        nodes = _alive()
        refuse_open([node["NodeManagerAddress"] for node in nodes], token=token_auth())
        for node in nodes:
            refuse_bytes(node["NodeManagerHostname"], node["Resources"])
        boxes = self.boxes()
        if not boxes:
            raise ConfigError(
                f"no node of this cluster has the resource {MARKER!r}",
                hint=f"where an arbiter runs: ray start --resources '{{\"{MARKER}\": 1000}}' …",
            )
        self.views(ANSWER_S if agent.running(boxes) else START_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._agents.clear()

    def boxes(self) -> dict[str, str]:
        """Return the name of each box by its node id: the label `box`, else the host's name."""
        return {
            node["NodeID"]: node["Labels"].get("box") or node["NodeManagerHostname"]
            for node in _alive()
            if node["Resources"].get(MARKER)
        }

    # -- what arbiters say
    def views(self, timeout_s: float = ANSWER_S) -> dict[str, View | None]:
        """Ask all boxes at once; None: no answer, unknown. An agent that died is started again with
        the next questions."""
        asked_at = time.monotonic()
        answers = self._answers(timeout_s, "view")
        return {node: view and replace(view, at=asked_at) for node, view in answers}

    def why(self, consumer: str) -> dict[str, Message | None]:
        """Return what each arbiter says of a consumer, by node; None: no answer."""
        return dict(self._answers(ANSWER_S, "why", consumer))

    def order(self, need_bytes: int, model: str) -> list[Ranked]:
        """Return all boxes, best first, those of no use last, each with its reason. Raises
        VramInsufficient for a need beyond every budget."""
        names = self.boxes()
        ranked = placement.rank(self.views(), need_bytes, model, time.monotonic(), self._rng)
        return [replace(one, box=names.get(one.node, one.node)) for one in ranked]

    # -- actors
    def spread(
        self,
        cls: Any,
        *args: Any,
        per_node: int = 1,
        nodes: Sequence[str] | None = None,
        **named: Any,
    ) -> list[Any]:
        """Start `per_node` actors on each node and return their handles at once, best node first.

        A `@leased` class goes to all boxes whose arbiter answers and whose budget suffices, and a
        warning names the others; another class goes to all nodes, each of its actors with the CPUs
        that Ray counts for it. `nodes`: ids to use instead. Ray restarts the dead, elsewhere if
        their node died.

        Raises: BadRequest, NotPermitted, VramInsufficient, and Refused if no box may be used.
        """
        spec, options = _options(cls)
        if nodes is None and spec is not None:
            ranked = self.order(spec.need_bytes, spec.model)
            nodes = [one.node for one in ranked if one.usable]
            for one in ranked[len(nodes) :]:
                log.warning("no actor on %s: %s", one.box, one.reason)
            if not nodes:
                raise _no_box(spec, {one.node: one.reason for one in ranked})
        return [
            _start(cls, options, node, args, named)
            for node in ([one["NodeID"] for one in _alive()] if nodes is None else nodes)
            for _ in range(per_node)
        ]

    def place(self, cls: Any, *args: Any, **named: Any) -> Any:
        """Start one actor of a `@leased` class on the best box and return its handle when its model
        is loaded. Where its wait for a grant ends it is started on the next box, then killed.

        Raises: BadRequest, NotPermitted, VramInsufficient, and Refused with what each box said.
        """
        spec, options = _options(cls)
        if spec is None:
            raise BadRequest(f"{cls} is not @leased", hint="spread it, or decorate its class")
        tried: dict[str, str] = {}
        before: Any = None
        while nodes := self._untried(spec, tried):
            actor = _start(cls, options, nodes[0], args, named)
            refused = _refused(actor, spec.wait_s + START_S)
            _kill(before)
            if refused is None:
                return actor
            tried[nodes[0]], before = refused, actor
        _kill(before)
        raise _no_box(spec, tried)

    def map(
        self,
        actors: Sequence[Any],
        method: str,
        seeds: Iterable[int],
        *,
        out: Path | str,
        deadline_s: float,
        on_result: Callable[[Result], object] | None = None,
    ) -> Iterator[Result]:
        """Yield `actor.method(seed)` of all seeds, each once: see `mapping.map_results`."""
        return map_results(actors, method, seeds, Path(out), deadline_s, on_result)

    # -- steps
    def _answers(self, timeout_s: float, method: str, *asked: str) -> Iterator[tuple[str, Any]]:
        """Yield the answer of each node's agent; None: there is none."""
        import ray

        sent: dict[str, Any] = {}
        boxes = self.boxes()
        for node, box in boxes.items():
            if node not in self._agents:
                self._agents[node] = agent.start(node, box)
            with contextlib.suppress(ray.exceptions.PendingCallsLimitExceeded):
                sent[node] = getattr(self._agents[node], method).remote(*asked)
        ray.wait(list(sent.values()), num_returns=len(sent), timeout=timeout_s)
        for node in boxes:
            yield node, self._got(node, sent.get(node))

    def _got(self, node: str, question: Any) -> Any:
        from ray import exceptions, get

        try:
            return None if question is None else get(question, timeout=0)
        except (exceptions.GetTimeoutError, exceptions.RayTaskError):
            return None  # it is late, or its arbiter does not answer
        except exceptions.RayError:
            del self._agents[node]  # it is dead
            return None

    def _untried(self, spec: LeasedSpec, tried: dict[str, str]) -> list[str]:
        ranked = self.order(spec.need_bytes, spec.model)
        return [one.node for one in ranked if one.usable and one.node not in tried]


@contextlib.contextmanager
def connected(address: str) -> Iterator[Fleet]:
    """Connect this process to a Ray cluster for a block. Raises ArbiterUnreachable where there is
    none, and what entering a fleet raises."""
    need("a fleet", "ray", extra="ray")
    import ray

    host, _, port = address.rpartition(":")
    try:
        if host:  # else Ray looks on this machine; where nothing listens it would try for minutes
            socket.create_connection((host, int(port)), CONNECT_S).close()
        ray.init(address=address, logging_level="ERROR", log_to_driver=False)
    except (OSError, RuntimeError, ValueError) as error:
        raise ArbiterUnreachable(
            f"no Ray cluster answers at {address}: {error}",
            hint="name one as HOST:PORT; where it has authentication, set RAY_AUTH_TOKEN too",
        ) from None
    try:
        with Fleet() as fleet:
            yield fleet
    finally:
        ray.shutdown()


# -- Ray
def _options(cls: Any) -> tuple[LeasedSpec | None, JsonObject]:
    """Return what a class leases, and the options of its actors. Raises BadRequest for resources
    beside a lease."""
    made = getattr(getattr(cls, "__ray_metadata__", None), "modified_class", cls)
    given = dict(getattr(cls, "_default_options", {}))
    spec: LeasedSpec | None = getattr(made, "leased", None)
    options: JsonObject = {"max_restarts": -1}
    if spec is not None:
        refuse_options(given)
        # a CPU that it held while it waits for a lease could be what the holder waits for
        options |= {"num_cpus": 0, "resources": {MARKER: SLIVER}}
    return spec, options


def _start(cls: Any, options: JsonObject, node: str, args: Sequence[Any], named: JsonObject) -> Any:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    remote: Any = cls if hasattr(cls, "__ray_metadata__") else ray.remote(cls)
    on = NodeAffinitySchedulingStrategy(node, soft=True)
    return remote.options(scheduling_strategy=on, **options).remote(*args, **named)


def _alive() -> list[JsonObject]:
    """Return what Ray says of its nodes that are alive."""
    import ray

    return [node for node in ray.nodes() if node["Alive"]]


def _refused(actor: Any, within_s: float) -> str | None:
    """Load an actor's model; return why it cannot be on its box. Raises what its `load` raises."""
    from ray import exceptions, get

    try:
        get(actor.__ray_call__.remote(hold), timeout=within_s)
    except exceptions.RayTaskError as error:
        if not isinstance(error.cause, Refused):
            raise
        return str(error.cause)
    except (exceptions.RayActorError, exceptions.GetTimeoutError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def _kill(actor: Any) -> None:
    import ray

    if actor is not None:
        ray.kill(actor)


def _no_box(spec: LeasedSpec, told: JsonMap) -> Refused:
    return Refused(
        f"no box has room for {spec.model}: "
        + ("; ".join(f"{node[:8]}: {why}" for node, why in told.items()) or "none may be tried"),
        hint="`vramctl fleet status` shows the boxes, `vramctl fleet why` a consumer's wait",
        details={"boxes": dict(told)},
    )
