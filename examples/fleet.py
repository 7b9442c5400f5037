"""Numbered episodes on a fleet: actors of Ray whose model is on a GPU by a lease of their box.

Start the arbiter first: `vram-arbiter --gpu fake:8GiB` simulates a GPU. A box is a node of Ray with
the resource `vram_arbiter`; here it is this machine, on loopback, because Ray runs the code of
whoever reaches it. The same command again plays only episodes without a result.

    ray start --head --node-ip-address=127.0.0.1 --resources='{"vram_arbiter": 1000}'
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


ray.init(address="auto")
out = Path(sys.argv[1] if sys.argv[1:] else "out/episodes")
with Fleet() as fleet:
    policies = fleet.spread(Policy)
    for result in fleet.map(policies, "episode", range(6), out=out, deadline_s=60):
        print(f"episode {result.seed}: {result.value['success']}, {result.value['net']}")
