"""Hunt for bytes that break a parser: `make fuzz MINUTES=5 TARGET=zmtp`.

atheris (libFuzzer) changes the corpus of each target, guided by the lines that are reached, each
target in a process of its own. What reaches new lines stays in out/fuzz/NAME/corpus, where the next
run begins. A finding ends its target's run and stays beside it: put it into tests/fuzz/corpus/NAME,
whose test then fails, mend the parser, and leave the file there.
"""

import argparse
import functools
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

INPUT_MAX_BYTES = 16_384
INPUT_LIMIT_S = 20
MEMORY_MAX_MB = 2_048


def hunt_here(name: str, options: Sequence[str]) -> None:
    """Fuzz one target until the options of libFuzzer end the process."""
    import atheris

    with atheris.instrument_imports(include=["vram_arbiter"]):
        from tests.fuzz.targets import CORPUS, TARGETS, try_input

        target = functools.partial(try_input, TARGETS[name])
        for path in (CORPUS / name).iterdir():  # functions import, too
            target(path.read_bytes())
    atheris.Setup([sys.argv[0], *options], target)
    atheris.Fuzz()


def hunt(name: str, seconds: int, out: Path) -> bool:
    """Fuzz a target in a process of its own, and print how it went. Returns whether it broke."""
    folder = out / name
    (folder / "corpus").mkdir(parents=True, exist_ok=True)
    options = [
        f"-max_total_time={seconds}", f"-max_len={INPUT_MAX_BYTES}", f"-timeout={INPUT_LIMIT_S}",
        f"-rss_limit_mb={MEMORY_MAX_MB}", f"-artifact_prefix={folder}/finding-",
        "-print_final_stats=1", str(folder / "corpus"), f"tests/fuzz/corpus/{name}",
    ]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.fuzz_run", "--here", name, *options],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
    )  # fmt: skip
    (folder / "log").write_text(done.stdout)
    tried = re.search(r"number_of_executed_units: (\d+)", done.stdout)
    kept = len(list((folder / "corpus").iterdir()))
    ended = "ok" if done.returncode == 0 else f"BROKEN, see {folder}"
    print(f"{name:<20} {tried[1] if tried else '?':>9} inputs, {kept:>4} kept: {ended}", flush=True)
    return done.returncode != 0


def main() -> int:
    if sys.argv[1:2] == ["--here"]:
        hunt_here(sys.argv[2], sys.argv[3:])
    from tests.fuzz.targets import TARGETS

    parser = argparse.ArgumentParser(prog="fuzz_run", description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0, help="of all targets together")
    parser.add_argument("--target", choices=TARGETS, action="append", help="only this one")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    args = parser.parse_args()
    names = args.target or [*TARGETS]
    workers = min(len(names), os.cpu_count() or 1)
    seconds = max(1, int(args.minutes * 60 * workers / len(names)))
    with ThreadPoolExecutor(workers) as pool:
        broken = [*pool.map(lambda name: hunt(name, seconds, args.out), names)]
    return int(any(broken))


if __name__ == "__main__":
    sys.exit(main())
