"""Tool calls: what a model may say, what is refused, and that what is offered is what is
accepted."""

import json
import re
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.schemas.errors import BadRequest, UnknownOp
from vram_arbiter.schemas.tools import (
    TOOL_CALL,
    TOOL_NAME_MAX_CHARS,
    TOOLS,
    ExecuteRskill,
    function_schema,
    parse_skill_call,
    parse_tool_call,
    skill_function,
    skill_tool_name,
)

CALLS: dict[str, dict[str, Any]] = {
    "execute_rskill": {"rskill_id": "acme/rskill-grab", "prompt": "grab the red cube"},
    "locate_in_view": {"query": "red cube"},
    "query_scene": {"question": "Is the cube held?", "camera": "wrist"},
    "look": {"camera": "wrist"},
    "query_task_progress": {"window_s": 4.0, "task": "grab the red cube"},
    "lifecycle_transition": {"node": "detector", "transition": "deactivate"},
    "emit_prompt": {"target_topic": "/operator", "text": "I cannot find it."},
    "wait": {},
    "stop_goal": {"rationale": "a person is in the way"},
}


@pytest.mark.parametrize("name", TOOLS)
def test_call_from_json_from_a_mapping_and_back(name: str) -> None:
    call = parse_tool_call(name, json.dumps(CALLS[name]))
    assert call == parse_tool_call(name, CALLS[name])
    assert call.tool == name
    assert TOOL_CALL.validate_json(call.model_dump_json()) == call


@pytest.mark.parametrize("key", ["rationale", "rational"])
def test_both_spellings_of_the_reason(key: str) -> None:
    assert (
        parse_tool_call("query_scene", {"question": "?", key: "to be sure"}).rationale
        == "to be sure"
    )


def test_goal_params_are_a_json_object() -> None:
    call = parse_tool_call("execute_rskill", {"rskill_id": "a/b", "goal_params_json": '{"x": 1}'})
    assert isinstance(call, ExecuteRskill)
    assert call.goal_params == {"x": 1}
    assert ExecuteRskill(rskill_id="a/b").goal_params == {}


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("execute_rskill", "{", "the arguments are not JSON"),
        ("execute_rskill", "[]", "the arguments are not a JSON object"),
        ("execute_rskill", "", "rskill_id: Field required"),
        ("execute_rskill", {"rskill_id": "a", "deadline_s": -1},
         "deadline_s: Input should be greater"),
        ("execute_rskill", {"rskill_id": "a", "goal_params_json": "[1]"},
         "goal_params_json: .*a JSON object"),
        ("execute_rskill", {"rskill_id": "a", "goal_params_json": "x"},
         "goal_params_json: .*a JSON object"),
        ("execute_rskill", {"rskill_id": "a", "patience_s": 0}, "patience_s: "),
        ("locate_in_view", {"query": ""}, "query: "),
        ("locate_in_view", {"query": "x", "zoom": 2}, "zoom: Extra"),
        ("lifecycle_transition", {"node": "x", "transition": "shutdown"}, "transition: "),
        ("emit_prompt", {"target_topic": "operator", "text": "x"}, "target_topic: "),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(
    name: str, arguments: str | dict[str, Any], message: str
) -> None:
    with pytest.raises(BadRequest, match=message):
        parse_tool_call(name, arguments)


def test_the_name_decides_which_tool_is_called() -> None:
    with pytest.raises(BadRequest, match="question"):
        parse_tool_call("query_scene", {"tool": "locate_in_view", "query": "x"})


def test_unknown_tool_lists_the_known_ones() -> None:
    with pytest.raises(UnknownOp, match="choose from execute_rskill") as caught:
        parse_tool_call("format_disk", {})
    assert caught.value.details["known"] == list(TOOLS)


@pytest.mark.parametrize("name", TOOLS)
def test_function_schema_offers_what_the_class_accepts(name: str) -> None:
    schema = function_schema(TOOLS[name])
    assert schema["type"] == "function"
    function = schema["function"]
    assert function["name"] == name
    assert function["description"]
    assert set(function["parameters"]["properties"]) == set(TOOLS[name].model_fields) - {"tool"}
    assert set(function["parameters"].get("required", [])) <= set(CALLS[name])
    assert function["parameters"]["additionalProperties"] is False


NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,40}/[A-Za-z0-9._-]{1,60}", fullmatch=True)


@settings(max_examples=40)
@given(st.lists(NAMES, min_size=2, max_size=6, unique=True))
def test_each_skill_has_a_function_name_of_its_own(names: list[str]) -> None:
    made = [skill_tool_name(name) for name in names]
    assert len(set(made)) == len(made)
    assert all(
        re.fullmatch(r"[A-Za-z0-9_-]+", name) and len(name) <= TOOL_NAME_MAX_CHARS for name in made
    )


def test_function_names_that_need_a_suffix() -> None:
    assert skill_tool_name("lab/grab-it_2") == "execute_rskill__lab__grab-it_2"
    assert re.fullmatch(r"execute_rskill__lab__a_b_[0-9a-f]{8}", skill_tool_name("lab/a.b"))
    assert skill_tool_name("a__b/c") != skill_tool_name("a/b__c")
    assert len(skill_tool_name("lab/" + "x" * 200)) == TOOL_NAME_MAX_CHARS


def test_a_skills_function_takes_its_parameters_by_name() -> None:
    schema = {"type": "object", "properties": {"x": {"type": "number"}}}
    function = skill_function("lab/go", "Drive.", schema)["function"]
    assert function["parameters"]["properties"]["goal_params"] == schema
    assert function["parameters"]["additionalProperties"] is False
    assert parse_skill_call("lab/go", '{"goal_params": {"x": 1}}').goal_params == {"x": 1}
    for wrong in (
        '{"goal_params": [1]}',
        '{"rskill_id": "lab/other"}',
        '{"goal_params_json": "{}"}',
        '{"tool": "wait"}',
    ):
        with pytest.raises(BadRequest):
            parse_skill_call("lab/go", wrong)


@pytest.mark.parametrize(
    "arguments",
    [
        '{"rskill_id": "a/b", "goal_params_json": "{\\"x\\": NaN}"}',
        '{"rskill_id": "a/b", "goal_params_json": "{\\"x\\": 1e999}"}',
        '{"rskill_id": "a/b", "deadline_s": Infinity}',
        '{"rskill_id": "a/b", "rskill_id": "a/c"}',
        '{"rskill_id": ' + "[" * 100_000,
        {"rskill_id": "a/b", "deadline_s": float("nan")},
    ],
)
def test_numbers_that_are_none_and_keys_given_twice_are_refused(arguments: Any) -> None:
    """Regression: a language model's `NaN` reached a skill; Python's JSON reader accepts it."""
    with pytest.raises(BadRequest):
        parse_tool_call("execute_rskill", arguments)
