"""Entry point of `vramctl`, under a name that no other project has.

The six packages have common names. Beside a project with its own `schemas/` or `clients/` (on PYTHONPATH, or in the current folder) the
program would not even reach `vramctl doctor`, which is there to say so. This module imports nothing but the standard library.
"""

import os
import sys

PACKAGES = ("arbiter", "clients", "sidecars", "runner", "reasoner", "schemas")
UNHEALTHY = 1


def main() -> None:
    """Run `vramctl`, or say which foreign package stands in its way."""
    try:
        from clients.cli.main import main as run
    except ImportError:
        foreign = {name: where for name, where in origins().items() if not is_ours(where)}
        if not foreign:
            raise
        sys.exit(shadowed(foreign))
    run()


def origins() -> dict[str, str | None]:
    """Folder (or file) that each package would be imported from; None: it is not found."""
    import importlib.util  # `vramctl status` starts without it

    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):
            spec = None
        places = list(spec.submodule_search_locations or ()) if spec else []
        found[name] = (places[0] if places else spec.origin) if spec else None
    return found


def is_ours(where: str | None) -> bool:
    """All six lie beside this module."""
    home = os.path.dirname(os.path.realpath(__file__))
    return where is not None and os.path.dirname(os.path.realpath(where)) == home


def shadowed(foreign: dict[str, str | None]) -> int:
    """Print what is wrong; for `doctor` as its table."""
    if sys.argv[1:2] == ["doctor"]:
        for name, where in origins().items():
            if name in foreign:
                print(f"BAD  {name:<18} {where or 'not found'} (not of this installation)")
            else:
                print(f"ok   {name:<18} {where}")
    for name, where in foreign.items():
        print(
            f"vramctl: the package {name} is found at {where or 'no place'}, which is not of this installation",
            file=sys.stderr,
        )
    print(
        "vramctl: start it from another folder, or take that folder off PYTHONPATH (vramctl is in "
        f"{os.path.dirname(os.path.realpath(__file__))})",
        file=sys.stderr,
    )
    return UNHEALTHY


if __name__ == "__main__":
    main()
