"""Goals of ROS actions for the stand-ins: the manifest's default goal updated with the request.

Pure; checked field by field by a pydantic model of the stand-in.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from pydantic import BaseModel, ValidationError

from vram_arbiter.runner.protocols import GoalParams
from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonObject, Message


def merge(base: GoalParams, over: GoalParams) -> JsonObject:
    """Deep merge: maps are merged, everything else of `over` replaces."""
    merged = dict(base)
    for key, value in over.items():
        known = merged.get(key)
        merged[key] = (
            merge(known, value)
            if isinstance(known, Mapping) and isinstance(value, Mapping)
            else value
        )
    return merged


def parse_goal[Message: BaseModel](
    message: type[Message], manifest: RSkillManifest, params: GoalParams
) -> Message:
    """Merge the goal's parameters over the manifest's defaults. Raises BadRequest, field by
    field.
    """
    defaults = (
        json.loads(manifest.ros_integration.default_goal_json) if manifest.ros_integration else {}
    )
    return checked(message, merge(defaults, params))


def checked[Message: BaseModel](message: type[Message], params: GoalParams) -> Message:
    """Return a goal's parameters as a model. Raises BadRequest, field by field."""
    try:
        return message.model_validate(params)
    except ValidationError as error:
        fields = [
            {"path": ".".join(map(str, item["loc"])) or "goal_params", "problem": item["msg"]}
            for item in error.errors(include_url=False, include_input=False)
        ]
        text = "; ".join(f"{field['path']}: {field['problem']}" for field in fields)
        raise BadRequest(f"goal_params: {text}", details={"fields": fields}) from error
