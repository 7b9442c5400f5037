"""A playbook is read and obeyed, never executed."""

from pathlib import Path

import pytest

from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.playbooks import BODY_MAX_BYTES, load_playbook
from vram_arbiter.schemas.errors import ConfigError, ManifestInvalid
from vram_arbiter.schemas.tools import EmitPrompt, ExecuteRskill, LocateInView, QueryScene

PALETTE = Palette(
    (
        Skill("lab/go", "ros_action", "drive", ("navigate",)),
        Skill("acme/search", "playbook", "search", ("plan",)),
    ),
    topics=frozenset({"/operator"}),
)


def playbook_file(
    folder: Path, *, body: str = "./PLAYBOOK.md", tools: str = "[locate_in_view, execute_rskill]"
) -> Path:
    file = folder / "rskill.yaml"
    file.write_text(
        'name: acme/search\nversion: "0.1.0"\nlicense: apache-2.0\nrole: s2\nkind:'
        " playbook\nembodiment_tags: [any]\n"
        "chunk_size: 1\nlatency_budget: {per_chunk_ms: 5000}\ndescription: How to look for a"
        " thing.\nactions: [plan]\n"
        f"playbook: {{trigger: a thing is lost, body_uri: {body}, composes_tools: {tools}, "
        "done_predicate: it is in view, max_steps: 4}\n"
    )
    (folder / "PLAYBOOK.md").write_text("Turn left first.\n")
    return file


def test_a_playbook_tells_how_and_narrows_what(tmp_path: Path) -> None:
    playbook = load_playbook(playbook_file(tmp_path))
    assert "Turn left first." in playbook.procedure
    assert "It is done when: it is in view. You have 4 steps." in playbook.procedure
    assert playbook.contract.max_steps == 4
    narrow = playbook.narrow(PALETTE)
    assert {function["function"]["name"] for function in narrow.functions()} == {
        "execute_rskill__lab__go",
        "locate_in_view",
    }
    assert narrow.check(ExecuteRskill(rskill_id="lab/go")) is None
    assert narrow.check(LocateInView(query="x")) is None
    for call in (QueryScene(question="x"), EmitPrompt(target_topic="/operator", text="x")):
        assert "is not a tool of this playbook" in str(narrow.check(call))
        assert PALETTE.check(call) is None


def test_a_playbook_is_refused_as_a_skill_with_the_way_to_use_it() -> None:
    assert "it is a text for the planner: --playbook" in str(
        PALETTE.check(ExecuteRskill(rskill_id="acme/search"))
    )


def test_what_is_wrong_with_a_playbook_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="query_scene, which is not provided"):
        load_playbook(playbook_file(tmp_path, tools="[query_scene]")).narrow(
            Palette(PALETTE.skills, can_query=False)
        )
    with pytest.raises(ManifestInvalid, match="unknown tool format_disk"):
        load_playbook(playbook_file(tmp_path, tools="[format_disk]"))
    with pytest.raises(ConfigError, match="outside of the playbook's folder"):
        load_playbook(playbook_file(tmp_path, body="../../etc/passwd"))
    with pytest.raises(ConfigError, match="cannot be read"):
        load_playbook(playbook_file(tmp_path, body="./NOTES.md"))
    file = playbook_file(tmp_path)
    (tmp_path / "PLAYBOOK.md").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_playbook(file)
    (tmp_path / "PLAYBOOK.md").write_bytes(b"x" * (BODY_MAX_BYTES + 1))
    with pytest.raises(ConfigError, match="more than"):
        load_playbook(file)
    file.write_text("kind: playbook\n")
    with pytest.raises(ManifestInvalid):
        load_playbook(file)
