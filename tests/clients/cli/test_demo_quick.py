"""`vramctl demo --quick`, in whatever environment the tests run: `make test-core` has the base
install alone."""

import re
import tempfile

import pytest

from tests.support.process import vramctl
from vram_arbiter.clients.cli.main import run_main


def test_three_programs_take_turns_and_the_timeline_follows() -> None:
    """Each loads, and the bytes of a victim are measured back before another one is granted.

    It failed after 60 s on a busy machine, and left its folder outside the run's.
    """
    elsewhere = {"VRAM_ARBITER_ENDPOINT": "ipc:///nowhere/arbiter.sock"}  # not the demo's affair
    done = vramctl("demo", "--quick", environ=elsewhere | {"TMPDIR": tempfile.gettempdir()})
    assert done.returncode == 0, done.stdout + done.stderr
    told, _, drawn = done.stdout.partition("\n\n")
    assert "took over from" in told
    assert "memory measured back, verdict verified" in told
    assert ": oom" not in told
    for name in ("detector", "scene-vlm", "grab"):
        assert f"{name}: ready" in told
        assert re.search(rf"^{name} .*█.*▼", drawn, re.MULTILINE), drawn


def test_other_options_do_not_apply(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run_main(["demo", "--quick", "--arbiter", "off"])
    assert ended.value.code == 2
    assert "--quick takes no other option" in capsys.readouterr().err
