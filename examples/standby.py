"""Standby: a lease that leaves when another program needs the room, and comes back by itself.

The detector is evicted for a training job. When the job ends, the arbiter grants the lease again
and calls `restore`; the program does nothing for it.
"""

from vram_arbiter import Client, Lease

weights: list[str] = []  # stands for the model's tensors


def load(lease: Lease) -> None:
    weights.append("loaded")
    print("detector: loaded")


def unload() -> None:
    weights.clear()
    print("detector: unloaded")


with (
    Client("detector") as arbiter,
    arbiter.lease(
        vram="5.3GB",
        model="owlv2",
        standby=True,  # come back when there is room
        unload=unload,
        restore=load,  # called at each return; the first load is the program's own
        min_residency_s=0.0,
    ) as detector,
):
    load(detector)
    detector.ready()
    with Client("training") as other, other.lease(vram="5GB", model="policy") as job:
        print(f"training is {job.state}, detector is {detector.state}")
    while detector.state != "held":
        detector.wait_change(detector.state)
    with detector.use("detect"):
        print(f"detector is {detector.state} again, with {len(weights)} weights")
