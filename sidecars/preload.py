"""First import of the server from which model processes are forked (`weights_keeper`).

Everything imported behind it is shared by all of them. The server outlives signals that are meant
for the whole group (Ctrl-C, systemd's SIGTERM): it ends with the sidecar's host, also while it
imports, and the host ends the models, each at its safe point.
"""

import os
import signal

import vram_arbiter.sidecars.model_main  # noqa: F401  reason: for every model process
from vram_arbiter.sidecars.parent import end_with
from vram_arbiter.sidecars.settings import HOST_VARIABLE, NICE_VARIABLE

end_with(int(os.environ.get(HOST_VARIABLE, os.getppid())))
signal.signal(signal.SIGTERM, signal.SIG_IGN)
# imports take all cores for seconds, beside a robot's control loop
os.setpriority(
    os.PRIO_PROCESS,
    0,
    max(int(os.environ.get(NICE_VARIABLE, "0")), os.getpriority(os.PRIO_PROCESS, 0)),
)
