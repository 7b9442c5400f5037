"""Reference pages of JSON Schemas, of the arbiter's configuration, of errors and of metrics."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import yaml

from vram_arbiter.clients.observer import names as of_the_arbiter  # noqa: F401  it describes metrics
from vram_arbiter.clients.selftest.rows import LAST, ROWS
from vram_arbiter.reasoner.llm import names as of_language_models  # noqa: F401  as above
from vram_arbiter.schemas.errors import CODES, VramError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry.names import INSTRUMENTS

type Schema = JsonMap


def schema_page(path: Path) -> str:
    """Return the page of one file of schemas/json."""
    schema: Schema = json.loads(path.read_text(encoding="utf-8"))
    return "\n\n".join([f"# {path.stem}.json", *_object(schema), *_definitions(schema)]) + "\n"


def schema_list(folder: Path) -> str:
    """Return links to the pages of the files of schemas/json."""
    return "\n".join(
        f"- [{path.name}](schemas/{path.stem}.md)" for path in sorted(folder.glob("*.json"))
    )


def _definitions(schema: Schema) -> Iterator[str]:
    definitions = schema.get("$defs", {})
    assert isinstance(definitions, dict)
    for name, definition in definitions.items():
        yield f"## {name}"
        yield from _object(definition)


def _object(schema: Schema) -> Iterator[str]:
    if description := schema.get("description"):
        yield _text(description)
    properties = schema.get("properties")
    if isinstance(properties, dict) and properties:
        required = schema.get("required", [])
        assert isinstance(required, list)
        rows = [_row(name, value, name in required) for name, value in properties.items()]
        head = ["| field | type | default | meaning |", "| --- | --- | --- | --- |"]
        yield "\n".join([*head, *rows])
    elif "properties" not in schema and "$defs" not in schema:
        yield kind(schema)


def _row(name: str, value: Schema, required: bool) -> str:
    default = "required" if required else f"`{json.dumps(value.get('default'))}`"
    if not required and "default" not in value:
        default = ""
    meaning = " ".join(_text(value.get("description", "")).split())
    return f"| `{name}` | {kind(value)} | {_cell(default)} | {_cell(meaning)} |"


def kind(schema: Schema) -> str:
    """Return the type of a value in words, with its range and links to the types it names."""
    match schema:
        case {"$ref": str(ref)}:
            name = ref.rpartition("/")[2]
            return f"[{name}](#{name.lower()})"
        case {"const": constant}:
            return f"`{json.dumps(constant)}`"
        case {"enum": [*values]}:
            return ", ".join(f"`{json.dumps(value)}`" for value in values)
        case {"anyOf": [*choices]} | {"oneOf": [*choices]}:
            return " or ".join(kind(choice) for choice in choices)
        case {"type": "array", "prefixItems": [*items]}:
            return "[" + ", ".join(kind(item) for item in items) + "]"
        case {"type": "array"}:
            items = schema.get("items", {})
            assert isinstance(items, dict)
            return f"list of {kind(items)}" + _range(schema, "minItems", "maxItems")
        case {"type": "object"} if isinstance(value := schema.get("additionalProperties"), dict):
            return f"map to {kind(value)}"
        case {"type": "string"}:
            return "text" + _range(schema, "minLength", "maxLength")
        case {"type": str(name)}:
            return name + _range(schema, "minimum", "maximum")
    return "any"


def _range(schema: Schema, low: str, high: str) -> str:
    bounds = [
        f"{sign} {schema[key]}"
        for sign, key in (
            ("≥", low), (">", "exclusiveMinimum"), ("≤", high), ("<", "exclusiveMaximum"),
        )
        if key in schema
    ]  # fmt: skip
    return f" ({', '.join(bounds)})" if bounds else ""


def configuration(text: str) -> str:
    """Return the tables of a commented configuration file: each key with the comment above it."""
    values = yaml.safe_load(text)
    parts: list[str] = []
    comment: list[str] = []
    section = ""
    for line in text.splitlines():
        if not line.strip():
            comment = []
        elif (stripped := line.strip()).startswith("#"):
            comment.append(stripped.removeprefix("#").removeprefix(" "))
        elif line[0] != " ":
            section = line.rstrip(":")
            parts += [f"\n## {section}\n", "| key | value | meaning |", "| --- | --- | --- |"]
            comment = []
        elif match := re.match(r" +(\w+):", line):
            value = json.dumps(values[section][match[1]])
            parts.append(f"| `{match[1]}` | `{value}` | {_comment(comment)} |")
            comment = []
    return "\n".join(parts)


def _comment(lines: list[str]) -> str:
    """Return a comment as one cell; indented lines, which are choices, keep lines of their own."""
    cell = ""
    choosing = False
    for line in lines:
        if choice := re.match(r" +(\S+) {2,}(.*)", line):
            cell += f"<br>`{choice[1]}`: {_cell(choice[2])}"
            choosing = True
        elif choosing and not line.startswith(" "):
            cell += f"<br>{_cell(line)}"
            choosing = False
        else:
            cell += f" {_cell(line)}"
    return cell.strip()


def metrics() -> str:
    """Return a table of every program's metrics."""
    rows = [
        f"| `{name}`{' h' if about.bounds else ''} | {about.unit} | {about.description} |"
        for name, about in sorted(INSTRUMENTS.items())
    ]
    return "\n".join(["| metric | unit | meaning |", "| --- | --- | --- |", *rows])


def decisions(folder: Path) -> str:
    """Return links to the records of decisions, by their titles."""
    titles = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("0*.md"))}
    return "\n".join(
        f"- [{text.partition('\n')[0].removeprefix('# ')}]({name})" for name, text in titles.items()
    )


def selftest() -> str:
    """Return the table of a self-test's rows."""
    rows = [f"| `{row.id}` | {row.what} | {row.limit} | {row.source} |" for row in (*ROWS, LAST)]
    return "\n".join(["| row | measures | limit | source |", "| --- | --- | --- | --- |", *rows])


def errors() -> str:
    """Return the table of the error codes."""
    rows = ["| code | type | needs | meaning |", "| --- | --- | --- | --- |"]
    for code, error in CODES.items():
        rows.append(
            f"| `{code}` | `{error.__name__}` | {_needs(error)} | {_cell(error.__doc__ or '')} |"
        )
    return "\n".join(rows)


def _needs(error: type[VramError]) -> str:
    for base in error.__mro__:
        if who := {
            "CallerError": "caller",
            "OperatorError": "operator",
            "TransientError": "time, or a retry",
        }.get(base.__name__):
            return who
    return "developers"


def _text(value: object) -> str:
    return str(value).strip()


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
