"""Detector of the bin picker: looks once for each line of its standard input.

It keeps its model on the GPU between looks, leaves when another program needs the room, and
returns for its next look.
"""

import sys
from collections.abc import Iterable

from vram_arbiter import Client, Lease, LeaseLost, LeaseRevoking


class Model:
    """Stands for a model: a real one moves its tensors to the GPU and back."""

    def load(self) -> None:
        pass

    def unload(self) -> None:
        pass

    def look(self, where: str) -> str:
        return f"nothing in {where}"


def serve(model: Model, looks: Iterable[str]) -> None:
    with Client("detector") as arbiter:
        lease = _loaded(arbiter, model)
        for where in looks:
            while True:
                try:
                    with lease.use(where):  # in use it is not evicted
                        print(model.look(where), flush=True)
                    break
                except (LeaseRevoking, LeaseLost):
                    lease.wait_gone()
                    lease = _loaded(arbiter, model)
        lease.give_up()


def _loaded(arbiter: Client, model: Model) -> Lease:
    lease = arbiter.acquire(vram="5GiB", unload=model.unload, min_residency_s=0.0)
    model.load()
    lease.ready()
    return lease


if __name__ == "__main__":
    serve(Model(), map(str.strip, sys.stdin))
