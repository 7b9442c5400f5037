"""The smallest consumer: wait for GPU memory, load a model, use it, give the memory back.

Start the arbiter first: `vram-arbiter --gpu fake:8GiB` simulates a GPU.
"""

from vram_arbiter import Client

weights: list[str] = []  # stands for the model's tensors

with Client("detector") as arbiter:
    # Returns when the arbiter grants the memory. `unload` is called when another program needs it.
    with arbiter.lease(vram="5.3GB", model="owlv2", unload=weights.clear) as lease:
        weights.append("loaded")
        with lease.use("detect"):  # marks the lease ready; inside, it is not evicted
            print(f"detecting on {lease.gpu}")
    print(f"released: {lease.state}, {len(weights)} weights left")
