"""Program that calls a function of a file: `python -m vram_arbiter.testing.call FILE MODULE NAME
ARGUMENTS`, with a JSON list of positional and named arguments."""

import json
import sys
from collections.abc import Callable, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from typing import Any


def command(function: Callable[..., object], *arguments: Any, **named: Any) -> Sequence[str]:
    """Return the command that calls a function. Raises TypeError for one that is not a file's own,
    and for arguments that JSON cannot express."""
    code, name = getattr(function, "__code__", None), function.__qualname__
    if code is None or not name.isidentifier():
        raise TypeError(f"expected a function at the top level of a file, got {name}")
    program = [sys.executable, "-m", __name__, code.co_filename, function.__module__]
    return [*program, name, json.dumps([arguments, named])]


def main(path: str, module: str, name: str, arguments: str) -> None:
    """Load the file as the module that it was for the caller, and call the function."""
    spec = spec_from_file_location(module, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = sys.modules[module] = module_from_spec(spec)
    spec.loader.exec_module(loaded)
    given, named = json.loads(arguments)
    getattr(loaded, name)(*given, **named)


if __name__ == "__main__":
    main(*sys.argv[1:])
