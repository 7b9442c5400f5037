"""JSON Schemas of everything that crosses a process border or lies in a file, made from the models
themselves.

One document a subject: `rskill.json` and the like have a root for editors, the documents of the
wires list every message under `$defs`. Makes texts only; `python -m vram_arbiter.schemas export`
writes them.
"""

import importlib
import json
import pkgutil
from dataclasses import fields, is_dataclass
from types import ModuleType
from typing import Any, Literal, is_typeddict

from pydantic import BaseModel, TypeAdapter

from vram_arbiter import schemas
from vram_arbiter.schemas import goals, wire
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.wire import requests

ROOTS: dict[str, str] = {
    "rskill": "vram_arbiter.schemas.manifest:RSkillManifest",
    "arbiter": "vram_arbiter.schemas.config.arbiter:ArbiterConfig",
    "observer": "vram_arbiter.schemas.config.observer:ObserverConfig",
    "gateway": "vram_arbiter.schemas.config.gateway:GatewayConfig",
    "robot": "vram_arbiter.schemas.config.robot:RobotEnvironment",
}
"""Documents with a single root: name → `module:class`."""

_DIALECT = "https://json-schema.org/draft/2020-12/schema"


def documents() -> dict[str, str]:
    """File name → text of every JSON Schema, the same on every machine."""
    found: dict[str, JsonObject] = {}
    for name, place in ROOTS.items():
        module, _, attribute = place.partition(":")
        model: type[BaseModel] = getattr(importlib.import_module(module), attribute)
        found[name] = model.model_json_schema()
    for name in modules():
        document = name.partition(".")[0]
        if defined := definitions(importlib.import_module(f"vram_arbiter.schemas.{name}")):
            empty = {"title": f"schemas.{document}", "$defs": {}}
            found.setdefault(document, empty)["$defs"].update(defined)
    return {
        f"{name}.json": json.dumps(
            {"$schema": _DIALECT, **schema}, indent=1, ensure_ascii=False, sort_keys=True
        )
        + "\n"
        for name, schema in sorted(found.items())
    }


def modules() -> list[str]:
    """Names of the modules of `schemas`; each that defines models gets its document.

    The modules of `wire` share one document. Other packages have roots instead.
    """
    plain = [found.name for found in pkgutil.iter_modules(schemas.__path__) if not found.ispkg]
    of_wire = [f"wire.{found.name}" for found in pkgutil.iter_modules(wire.__path__)]
    return [name for name in (*plain, *of_wire) if name[0] != "_"]


def public_models(module: ModuleType) -> list[type]:
    """The models, typed dicts and messages that a module defines, by name; not those behind an
    underscore, and not bases of others."""
    return [
        value
        for name, value in sorted(vars(module).items())
        if isinstance(value, type)
        and not name.startswith("_")
        and value.__module__ == module.__name__
        and not value.__subclasses__()
        and (
            issubclass(value, BaseModel)
            or is_typeddict(value)
            or (
                is_dataclass(value) and (".wire." in module.__name__ or ".goals" in module.__name__)
            )
        )
    ]


def definitions(module: ModuleType) -> JsonObject:
    """Return the schemas of what a module defines, by name."""
    mode: Literal["validation"] = "validation"
    inputs: list[tuple[str, Literal["validation"], TypeAdapter[Any]]] = [
        (model.__name__, mode, TypeAdapter(model)) for model in public_models(module)
    ]
    found, shared = TypeAdapter.json_schemas(inputs)
    defs = dict(shared.get("$defs", {}))
    for (name, _), schema in found.items():
        if schema != {"$ref": f"#/$defs/{name}"}:
            defs[name] = schema
    for model in public_models(module):
        if model.__name__ in defs:
            _as_sent(model, defs[model.__name__])
    return defs


def _as_sent(model: Any, schema: JsonObject) -> None:
    """Describe what `schemas.codec` makes of a dataclass: a list of its fields, or a map with its
    kind."""
    for field in fields(model) if is_dataclass(model) else ():
        if part := field.metadata.get("part"):
            del schema["properties"][field.name]
            schema["properties"][part] = {"type": "string", "title": part.capitalize()}
            required = [part if name == field.name else name for name in schema.get("required", ())]
            schema["required"] = sorted(required)
    if tag := getattr(model, "TAG", None):
        key, value = tag
        schema["properties"] = {key: {"const": value}, **schema.get("properties", {})}
        schema["required"] = sorted([key, *schema.get("required", ())])
    if issubclass(model, goals.RunnerCall):  # their defaults are for those who build them
        schema["properties"]["id"].pop("default")
        schema["required"] = sorted({"id", "op", *schema.get("required", ())})
    if issubclass(model, requests.Request):
        envelope = TypeAdapter(requests.Envelope).json_schema()
        schema["properties"].update(envelope["properties"])
        schema["required"] = sorted([*envelope["required"], *schema["required"]])
