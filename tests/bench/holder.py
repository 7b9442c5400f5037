"""A process that holds a lease until it is killed; says a line once it has it."""

import sys

from tests.bench.harness import Peer

if __name__ == "__main__":
    Peer(sys.argv[1], "victim").greeted().lease()
    print("holds", flush=True)
    sys.stdin.read()
