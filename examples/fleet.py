"""Numbered episodes on a fleet: actors of Ray whose model is on a GPU by a lease of their box.

Start the arbiter first: `vram-arbiter --gpu fake:8GiB` simulates a GPU. The fleet is this machine
alone; `ray.init(address="auto")` connects to a cluster. The same command again plays only episodes
without a result.

    python examples/fleet.py out/episodes
"""

import sys
from pathlib import Path
from typing import Any

import ray

from vram_arbiter.clients.ray import Fleet, leased


@leased(vram="5.3GB", model="policy", wait_s=30)
class Policy:
    lease: Any

    def load(self) -> None:  # after the grant
        self.net = f"weights on {self.lease.gpu}"

    def unload(self) -> None:  # between episodes, when another program needs the room
        self.net = ""

    def episode(self, seed: int) -> dict[str, object]:
        return {"success": seed % 3 > 0, "net": self.net}


# a box is a node with this resource; loopback, because Ray runs the code of whoever reaches it
ray.init(resources={"vram_arbiter": 1000}, _node_ip_address="127.0.0.1", include_dashboard=False)
out = Path(sys.argv[1] if sys.argv[1:] else "out/episodes")
with Fleet() as fleet:
    policies = fleet.spread(Policy)
    for result in fleet.map(policies, "episode", range(6), out=out, deadline_s=60):
        print(f"episode {result.seed}: {result.value['success']}, {result.value['net']}")
