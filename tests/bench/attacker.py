"""One attack of `tests.support.attacks` for some seconds: ATTACK SOCKET SECONDS."""

import sys
import time

from tests.support.attacks import ATTACKS

if __name__ == "__main__":
    print("up", flush=True)
    ATTACKS[sys.argv[1]](sys.argv[2], time.monotonic() + float(sys.argv[3]))
