"""`python -m clients` is `vramctl`."""

from clients.cli.main import main

if __name__ == "__main__":
    main()
