"""Results of a self-test as lines of a terminal, as JSON, and as Markdown for an issue."""

import json
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.selftest.run import Result, Verdict
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

MARKS: Final[Mapping[Verdict, str]] = {"pass": "✓", "miss": "✗", "failed": "✗", "skipped": "–"}
SIMULATED: Final = "SIMULATED GPU: the programs are tested, no claim about hardware is"
PACKAGES: Final = (
    "vram-arbiter", "torch", "transformers", "lerobot", "bitsandbytes", "nvidia-ml-py",
    "cuda-bindings",
)  # fmt: skip


def machine_of(gpu: Gpu) -> JsonMap:
    """Return what a reader of the results has to know; nothing that names the machine or a user."""
    return {
        "gpu": gpu.name,
        "memory": format_bytes(gpu.total_bytes),
        "driver": gpu.driver,
        "kernel": platform.release(),
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _version(name))},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def line_of(result: Result, *, simulated: bool) -> str:
    """Return a result as one line. A mark in brackets is of a simulated GPU."""
    mark = MARKS[result.verdict]
    mark = f"({mark})" if simulated and result.verdict == "pass" else f" {mark} "
    remark = result.remark if result.verdict == "pass" else f"{result.verdict}: {result.remark}"
    return printable(f"{mark} {result.id:<14}{_figure(result):>14}  {result.limit:<16}  {remark}")


def _figure(result: Result) -> str:
    if result.figure is None:
        return ""
    form = ".0f" if abs(result.figure) >= 100 else ".3g"
    return f"{result.figure:{form}} {result.unit}".rstrip()


def summary_of(results: Sequence[Result], *, simulated: bool) -> str:
    """Return the number of rows by verdict."""
    counts = Counter(one.verdict for one in results)
    said = ", ".join(f"{counts[one]} {one}" for one in MARKS if counts[one])
    return f"{said} ({SIMULATED})" if simulated else said


def as_json(machine: JsonMap, results: Sequence[Result], *, simulated: bool) -> str:
    """Return machine and rows as JSON."""
    rows = [asdict(one) for one in results]
    return json.dumps({"simulated": simulated, "machine": machine, "rows": rows}, indent=2) + "\n"


def as_markdown(machine: JsonMap, results: Sequence[Result], *, simulated: bool) -> str:
    """Return machine and rows as text for an issue."""
    packages = ", ".join(f"{name} {found}" for name, found in machine["packages"].items())
    lines = [f"## vramctl selftest: {summary_of(results, simulated=simulated)}", ""]
    lines += [f"- {name}: {machine[name]}" for name in machine if name != "packages"]
    lines += [f"- {packages}", "", "| row | claim | figure | limit | source | verdict | remark |"]
    lines.append("| --- " * 7 + "|")
    for one in results:
        cells = (one.id, one.what, _figure(one), one.limit, one.source, one.verdict, one.remark)
        lines.append(f"| {' | '.join(printable(cell).replace('|', '/') for cell in cells)} |")
    return "\n".join(lines) + "\n"
