"""Agent of a node: a detached actor that says what the node's arbiter says. It decides nothing and
remembers nothing.

An agent serves every driver of the cluster, and outlives them. `Fleet` starts those that are
missing; Ray ends them with their node.
"""

from collections.abc import Iterable
from typing import Any, Final

from vram_arbiter.clients.cli.status import all_pages
from vram_arbiter.clients.net.request import ask, checked
from vram_arbiter.clients.ray.placement import View, view_of
from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import AskWhy

NAMESPACE: Final = "vram_arbiter"
"""Of the agents' names: one for all drivers."""
CALLS_MAX: Final = 4
"""Questions to an agent at a time; one that stands still is asked no more."""


class Agent:
    """Runs on its node, whose environment names the arbiter. `box`: the node's name."""

    def __init__(self, box: str) -> None:
        self._box = box

    def view(self) -> View:
        """Raises ArbiterUnreachable, and what else the arbiter refuses."""
        return view_of(from_map(StatusReply, checked(all_pages(None))), self._box)

    def why(self, consumer: str) -> Message:
        """What keeps a consumer from running there, as `vramctl why --json` says it."""
        return checked(ask(AskWhy(consumer)))


def running(nodes: Iterable[str]) -> bool:
    """Whether each of these nodes has an agent, which may not answer."""
    import ray

    listed = ray.util.list_named_actors(all_namespaces=True)
    names = {one["name"] for one in listed if one["namespace"] == NAMESPACE}
    return names >= set(map(_name, nodes))


def start(node: str, box: str) -> Any:
    """Return the handle of a node's agent, which may still be starting."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    agent: Any = ray.remote(Agent)
    return agent.options(
        name=_name(node),
        namespace=NAMESPACE,
        get_if_exists=True,
        lifetime="detached",
        num_cpus=0,
        max_concurrency=CALLS_MAX,
        max_pending_calls=CALLS_MAX,
        scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False),
    ).remote(box)


def _name(node: str) -> str:
    return f"agent-{node}"
