"""Scenario files: what is refused, with its line, and one that passes or fails by its steps."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.testing import __main__ as program
from vram_arbiter.testing.scenario import load_scenario

HEAD = """\
gpu: 8GiB
lag: 50ms
consumers:
  detector: {vram: 5GiB, priority: 40}
  policy: {vram: 4GiB}
steps:
"""
EXAMPLE = textwrap.dedent((program.__doc__ or "").split("\n\n")[2])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            HEAD + "  - start: polic\n",
            ":7: steps[0]: no consumer 'polic' here; did you mean policy?",
        ),
        (HEAD + "  - strat: policy\n", ":7: steps[0].strat: unknown key; did you mean start?"),
        (HEAD + "  - {start: policy, stop: policy}\n", ":7: steps[0]: expected one of start, use"),
        (HEAD + "  - start:\n", ":7: steps[0]: expected one of start, use"),
        (HEAD + "  - expect: {policy: heald}\n", "'heald' is not one of"),
        (HEAD + "  - granted_before: [policy, robot]\n", "no consumer 'robot'"),
        (HEAD + "  - start: policy\n  - kill: detector\n", ":8: steps[1]: no consumer 'detector'"),
        (HEAD, "steps"),
        (HEAD.replace("50ms", "soon") + "  - start: policy\n", ":2: lag: expected a time such as"),
        (HEAD.replace("5GiB", "5 bananas") + "  - start: policy\n", ":4: consumers.detector.vram"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load_scenario(text, "x.yaml")
    assert said in str(raised.value)


def test_a_file_that_is_not_there_is_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main([str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml cannot be read" in capsys.readouterr().err


@pytest.mark.e2e
def test_the_example_of_the_help_passes_and_a_wrong_expectation_fails(tmp_path: Path) -> None:
    right, wrong = tmp_path / "right.yaml", tmp_path / "wrong.yaml"
    right.write_text(EXAMPLE)
    steps = "  - stowaway: 6GiB\n  - start: policy\n  - expect: {policy: held}\n"
    wrong.write_text(f"within_s: 0.5\n{HEAD}{steps}")
    code = (
        "import sys, vram_arbiter.testing.__main__ as p; print([p.main([f]) for f in sys.argv[1:]])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, right, wrong],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert done.stdout.endswith("[0, 1]\n")
    passed, _, failed = done.stdout.partition(f"{right}: passed\n")
    assert "revoke_asked" in passed
    assert "alloc 5 GiB by detector" in passed
    assert "alloc 6 GiB by stowaway" in failed
    said = (
        "step 3, expect: {'policy': 'held'}: not true within 0.5 s, last seen: the lease of policy"
    )
    assert f"{wrong}: {said}" in failed
