"""`vramctl doctor` on machines laid out in folders: each finding where it is due, and none on a
sound machine."""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from tests.clients.cli.doctor_cases import (
    CASES,
    GONE,
    NOT_FOUND,
    SOCKET,
    Case,
    arbiter_of,
    lay,
    silent,
    sound,
)
from tests.support.paths import ROOT
from vram_arbiter.clients.cli import doctor
from vram_arbiter.clients.cli.doctor.findings import WRONG, Finding, Report, Severity, examine
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.schemas.codec import to_map


@pytest.fixture
def sound_machine(tmp_path: Path) -> Machine:
    return sound(tmp_path)


def test_a_sound_machine_has_no_finding(sound_machine: Machine) -> None:
    findings = examine(sound_machine, doctor.CHECKS)
    assert [one for one in findings if one.severity is not Severity.OK] == []
    assert len(findings) >= len(doctor.CHECKS)


# -- each finding
@pytest.mark.parametrize("case", CASES, ids=str)
def test_each_finding_fires_and_names_a_command(case: Case, sound_machine: Machine) -> None:
    lay(sound_machine.root, dict(case.files))
    findings = examine(case.change(sound_machine), doctor.CHECKS)
    found = [one for one in findings if one.code == case.code]
    assert found, [one for one in findings if one.severity is not Severity.OK]
    assert case.fix in found[0].fix
    assert found[0].severity is not Severity.OK


def test_every_finding_has_a_case_and_a_line_in_the_reference() -> None:
    text = "".join(path.read_text() for path in (ROOT / "clients/cli/doctor").glob("*.py"))
    codes = set(re.findall(r'(?:error|warning|note)\(\s*f?"([a-z]+\.[a-z-]+)', text))
    assert len(codes) > 30
    tried = {case.code for case in CASES}
    assert {code for code in codes if not any(one.startswith(code) for one in tried)} == set()
    page = (ROOT / "docs/reference/doctor.md").read_text()
    assert {code for code in tried if f"`{code}`" not in page} == set()


# -- what cannot be examined
@pytest.mark.parametrize(
    ("code", "files", "change"),
    [
        ("devices.unknown", GONE, NOT_FOUND),
        ("suspend.unknown", {"/proc/driver/nvidia/params": None}, lambda m: m),
        ("daemon.unknown", {}, silent),
        ("probe.unknown", {}, silent),
        ("stowaways.unknown", {}, silent),
        ("versions.unknown", {}, silent),
        ("oom.unknown", {}, arbiter_of(pid=0)),
        ("permissions.unknown", {SOCKET: None}, silent),
        ("units.unknown", {}, lambda m: os.rename(m.path("/run/systemd"), m.root / "x") or m),
    ],
)
def test_what_cannot_be_examined_is_never_ok(
    code: str,
    files: Mapping[str, str | None],
    change: Callable[[Machine], Machine],
    sound_machine: Machine,
) -> None:
    lay(sound_machine.root, files)
    findings = {one.code: one for one in examine(change(sound_machine), doctor.CHECKS)}
    assert findings[code].severity is Severity.UNKNOWN
    assert findings[code].found.startswith("could not look: ")


def test_a_file_that_may_not_be_read_is_not_examined(
    sound_machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: object) -> list[str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "listdir", refuse)
    findings = {one.code: one for one in examine(sound_machine, doctor.CHECKS)}
    assert findings["units.unknown"].found == (
        "could not look: /etc/systemd/system: Permission denied"
    )


@pytest.mark.parametrize(
    ("params", "state"),
    [("UseKernelSuspendNotifiers: 1\nPreserveVideoMemoryAllocations: 0\n", "mem"), ("", "freeze")],
)
def test_a_driver_that_needs_no_units_for_a_suspend(
    params: str, state: str, sound_machine: Machine
) -> None:
    """NVIDIA 595 with open modules saves memory by the kernel's notifiers."""
    lay(sound_machine.root, {"/proc/driver/nvidia/params": params, "/sys/power/state": state})
    findings = examine(sound_machine, (("suspend", doctor.driver.suspend, "x"),))
    assert [one.severity for one in findings] == [Severity.OK]


def test_a_jetson_has_a_driver_of_its_own(sound_machine: Machine) -> None:
    """NVML is missing there, and doctor said that there was no GPU."""
    lay(sound_machine.root, {**GONE, "/dev/nvmap": ""})
    (found,) = examine(NOT_FOUND(sound_machine), (("driver", doctor.driver.driver, ""),))
    assert (found.code, found.severity) == ("driver.tegra", Severity.OK)


# -- the report
def test_a_report_is_typed_and_escaped() -> None:
    report = Report(
        "ipc:///x",
        (Finding("a.b", Severity.ERROR, "bad \x1b[2J", "mend"), Finding("c.d", Severity.OK, "y")),
    )
    assert to_map(report)["findings"][0] == {
        "code": "a.b", "severity": "error", "found": "bad \x1b[2J", "fix": "mend",
    }  # fmt: skip
    lines = doctor.lines_of(report)
    assert lines[1].startswith("ERROR    a.b")
    assert "\\x1b[2J" in lines[1]
    assert lines[2].endswith("→ mend")
    assert lines[-1] == "1 ok, 1 error"
    assert {Severity.WARNING, Severity.ERROR} == WRONG
