"""llama.cpp's own server in this process, on a CPU, with bytes on the simulated GPU.

`python -m tests.support.llama_server FOLDER BYTES MODEL.gguf PORT` writes its process to
MODEL.gguf.pid before it loads, and serves until SIGTERM.
"""

import os
import signal
import sys
from pathlib import Path

import xllamacpp

from tests.support.held_bytes import HeldBytes
from tests.support.tiny_gguf import CONTEXT


def main(folder: str, size: str, model: str, port: str) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # threads of llama.cpp inherit it
    held = HeldBytes(folder, size)
    Path(f"{model}.pid").write_text(str(os.getpid()))
    params = xllamacpp.CommonParams()
    params.model.path = model
    params.port = int(port)
    params.n_ctx = CONTEXT
    params.n_parallel = 1
    params.cpuparams.n_threads = 1
    params.warmup = False
    server = xllamacpp.Server(params)
    print(f"serves on {server.listening_address}", flush=True)
    signal.sigwait({signal.SIGTERM})
    held.close()
    os._exit(0)  # its threads serve on


if __name__ == "__main__":
    main(*sys.argv[1:])
