"""The VRAM arbiter: a central daemon that leases GPU memory, and the programs that hold leases."""
