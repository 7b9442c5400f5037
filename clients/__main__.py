"""`python -m clients` is `vramctl`."""

from vramctl import main

if __name__ == "__main__":
    main()
