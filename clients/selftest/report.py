"""Results of a self-test (`run.judged`): as lines of a terminal, as a map for JSON, and as Markdown
for an issue."""

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.selftest.run import Verdict
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

MARKS: Final[Mapping[Verdict, str]] = {"pass": "✓", "miss": "✗", "failed": "✗", "skipped": "–"}
SIMULATED: Final = "SIMULATED GPU: the programs are tested, no claim about hardware is"
PACKAGES: Final = ("vram-arbiter", "torch", "transformers", "lerobot", "bitsandbytes")


def line_of(result: JsonMap, *, simulated: bool) -> str:
    """Return a result as one line. A mark in brackets is of a simulated GPU."""
    verdict, mark = result["verdict"], MARKS[result["verdict"]]
    mark = f"({mark})" if simulated and verdict == "pass" else f" {mark} "
    remark = result["remark"] if verdict == "pass" else f"{verdict}: {result['remark']}"
    figure = "" if result["figure"] is None else f"{result['figure']:g} {result['unit']}".rstrip()
    return printable(f"{mark} {result['id']:<14}{figure:>14}  {result['limit']:<16}  {remark}")


def told(gpu: Gpu, results: Sequence[JsonMap], *, simulated: bool) -> JsonMap:
    """Return summary, machine and rows as a map; nothing in it names the machine or a user."""
    counts = Counter(one["verdict"] for one in results)
    summary = ", ".join(f"{counts[one]} {one}" for one in MARKS if counts[one])
    machine = {
        "gpu": gpu.name, "memory": format_bytes(gpu.total_bytes), "driver": gpu.driver,
        "kernel": platform.release(), "python": platform.python_version(),
    }  # fmt: skip
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            machine[package] = version(package)
    summary += f" ({SIMULATED})" if simulated else ""
    return {"summary": summary, "simulated": simulated, "machine": machine, "rows": results}


def markdown(told: JsonMap) -> str:
    """Return the map of `told` as text for an issue."""
    lines = [f"## vramctl selftest: {told['summary']}", ""]
    lines += [f"- {name}: {value}" for name, value in told["machine"].items()]
    columns = [name for name in told["rows"][0] if name != "seconds"]
    lines += ["", f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for one in told["rows"]:
        cells = ["" if one[name] is None else str(one[name]) for name in columns]
        lines.append(f"| {' | '.join(printable(cell).replace('|', '/') for cell in cells)} |")
    return "\n".join(lines) + "\n"
