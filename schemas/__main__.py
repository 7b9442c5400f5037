"""`python -m vram_arbiter.schemas check FILE…` and `python -m vram_arbiter.schemas export DIR`.

check   reads rSkill manifests and says `ok` or what is wrong, field by field. A folder stands for
the `rskill.yaml` in it. export  writes the JSON Schema of every file and message into DIR.

Exit status: 0 all good, 1 at least one file is invalid or could not be written, 2 wrong usage.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.schemas.export import documents
from vram_arbiter.schemas.manifest import ManifestError, load_manifest
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.printable import printable_lines
from vram_arbiter.schemas.runtime.version import add_version


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Parse, call, print. Returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m vram_arbiter.schemas", description=__doc__.splitlines()[0]
    )
    commands = parser.add_subparsers(dest="command", required=True)
    check = commands.add_parser("check", help="say `ok` or what is wrong with rSkill manifests")
    check.add_argument(
        "files", nargs="+", metavar="FILE", type=Path, help="an rskill.yaml, or a folder with one"
    )
    export = commands.add_parser("export", help="write JSON Schemas")
    export.add_argument(
        "folder", metavar="DIR", type=Path, help="folder to write to; made if missing"
    )
    for one in (parser, check, export):
        add_version(one)
    options = parser.parse_args(argv)
    return _check(options.files) if options.command == "check" else _export(options.folder)


def _check(files: Sequence[Path]) -> int:
    failed = 0
    for file in files:
        path = file / "rskill.yaml" if file.is_dir() else file
        try:
            manifest = load_manifest(path)
            if problems := manifest.not_executable():
                raise ManifestError(str(path), problems)
        except ManifestError as error:
            failed += 1
            print(printable_lines(error))
            continue
        print(f"{path}: ok")
        for warning in manifest.warnings():
            print(f"warning: {printable_lines(warning.at(str(path)))}", file=sys.stderr)
    if failed and len(files) > 1:
        print(f"{failed} of {len(files)} files are invalid", file=sys.stderr)
    return 1 if failed else 0


def _export(folder: Path) -> int:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in documents().items():
            (folder / name).write_text(text, encoding="utf-8")
            print(folder / name)
    except OSError as error:
        print(f"cannot write to {folder}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
