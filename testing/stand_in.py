"""A consumer for tests, for a process of its own: a lease, and its bytes on the simulated GPU."""

import sys
from contextlib import ExitStack
from typing import Any

from vram_arbiter.clients.sync import Client
from vram_arbiter.testing.gpu import FakeGpu


def hold(name: str, vram: str, **fields: Any) -> None:
    """Hold a lease with its bytes until the standard input ends; evicted, free them and stay.

    A line `use` begins a use, `idle` ends it. `fields` as of `Client.acquire`; with `standby` the
    bytes return with the lease.
    """
    gpu = FakeGpu(name=name)

    def load(_: object = None) -> None:
        gpu.allocate(vram)

    if fields.get("standby"):
        fields["restore"] = load
    with (
        Client(name) as arbiter,
        arbiter.lease(vram=vram, model=name, unload=gpu.free, **fields) as lease,
        ExitStack() as use,
    ):
        load()
        lease.ready()
        for line in sys.stdin:
            use.close()
            if line.strip() == "use":
                use.enter_context(lease.use("use"))
