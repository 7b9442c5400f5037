"""Programs that know nothing of the arbiter, under a lease that `vramctl run` holds for them.

`supervisor` keeps one program under its lease, `program` is its process tree, `actions` says how a
running program gives up GPU memory and takes it back: `http` and `servers` by a call of its own
API, `cuda_checkpoint` through the driver, without its help.
"""
