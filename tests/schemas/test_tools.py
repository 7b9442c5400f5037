"""Tool calls: what a model may say, what is refused, and that what is offered is what is accepted."""

import json
from typing import Any

import pytest

from schemas.errors import BadRequest, UnknownOp
from schemas.tools import TOOL_CALL, TOOLS, ExecuteRskill, function_schema, function_schemas, parse_tool_call

CALLS: dict[str, dict[str, Any]] = {
    "execute_rskill": {"rskill_id": "acme/rskill-grab", "prompt": "grab the red cube"},
    "locate_in_view": {"query": "red cube"},
    "query_scene": {"question": "Is the cube held?", "camera": "wrist"},
    "lifecycle_transition": {"node": "detector", "transition": "deactivate"},
    "emit_prompt": {"target_topic": "/operator", "text": "I cannot find it."},
}


@pytest.mark.parametrize("name", TOOLS)
def test_call_from_json_from_a_mapping_and_back(name: str) -> None:
    call = parse_tool_call(name, json.dumps(CALLS[name]))
    assert call == parse_tool_call(name, CALLS[name])
    assert call.tool == name
    assert TOOL_CALL.validate_json(call.model_dump_json()) == call


@pytest.mark.parametrize("key", ["rationale", "rational"])
def test_both_spellings_of_the_reason(key: str) -> None:
    assert parse_tool_call("query_scene", {"question": "?", key: "to be sure"}).rationale == "to be sure"


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
        ("execute_rskill", {"rskill_id": "a", "deadline_s": -1}, "deadline_s: Input should be greater"),
        (
            "execute_rskill",
            {"rskill_id": "a", "goal_params_json": "[1]"},
            "goal_params_json: .*a JSON object",
        ),
        ("execute_rskill", {"rskill_id": "a", "goal_params_json": "x"}, "goal_params_json: .*a JSON object"),
        ("execute_rskill", {"rskill_id": "a", "patience_s": 0}, "patience_s: "),
        ("locate_in_view", {"query": ""}, "query: "),
        ("locate_in_view", {"query": "x", "zoom": 2}, "zoom: Extra"),
        ("lifecycle_transition", {"node": "x", "transition": "shutdown"}, "transition: "),
        ("emit_prompt", {"target_topic": "operator", "text": "x"}, "target_topic: "),
    ],
)
def test_wrong_arguments_are_named(name: str, arguments: str | dict[str, Any], message: str) -> None:
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


def test_function_schemas_of_some_or_all() -> None:
    assert [schema["function"]["name"] for schema in function_schemas(["query_scene"])] == ["query_scene"]
    assert len(function_schemas()) == len(TOOLS)
