"""Product files that one more request of the wire touches: `python tests/measure_request.py [OP…]`.

A file counts that names the request's class, the class of its reply where no other request has
that, or imports from the wire and defines a function of the op's name. A program that only calls
these is not counted.
"""

import argparse
import ast
import sys
from collections import Counter
from collections.abc import Iterator, Set
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "src"))

from vram_arbiter.schemas.wire.requests import REPLIES, REQUESTS

ROOT = Path(__file__).parents[1]
FOLDERS = ("arbiter", "clients", "schemas")
OPS = ("prepare", "revoke_ack", "release_dead", "oom", "reacquire")
"""One that the session answers, two of few words, and two with more about them."""
TARGET = 5


def classes_of(op: str) -> set[str]:
    cls = REQUESTS[op]
    shared = Counter(REPLIES.values())[REPLIES[cls]] > 1
    return {cls.__name__, *([] if shared else [REPLIES[cls].__name__])}


def named(tree: ast.AST) -> Iterator[str]:
    """Yield every name of a module, and the functions that one of the wire defines."""
    modules = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    of_wire = any(".schemas.wire" in module for module in modules)
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.ClassDef(name=name):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if of_wire:
                yield f"{name}()"


def touched(words: Set[str]) -> list[str]:
    paths = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    trees = ((path, ast.parse(path.read_text("utf-8"))) for path in paths)
    return [str(path.relative_to(ROOT)) for path, tree in trees if words & set(named(tree))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ops", nargs="*", default=OPS)
    for op in parser.parse_args().ops:
        classes = classes_of(op)
        files = touched(classes | {f"{op}()"})
        print(f"{len(files):3} (target {TARGET})  {', '.join(sorted(classes))}")
        print("".join(f"      {name}\n" for name in files), end="")


if __name__ == "__main__":
    main()
