"""`python -m vram_arbiter.clients` is `vramctl`."""

from vram_arbiter.clients.cli.main import main

if __name__ == "__main__":
    main()
