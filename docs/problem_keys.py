"""Write docs/reference/problem_keys.md, the keys of a problem file, from its schema: `python docs/problem_keys.py`."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from seaopt.problem import json_schema

PAGE = Path(__file__).resolve().parent / "reference" / "problem_keys.md"
HEAD = """# Keys of a problem file

Every table and every key, from the schema that files are checked by (`seaopt schema problem`); written by
`python docs/problem_keys.py`. [The problem file](problem_file.md) has them in use.
"""
KINDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false", "object": "table"}
ENDS = {
    "minimum": "from {:g}",
    "exclusiveMinimum": "above {:g}",
    "maximum": "to {:g}",
    "exclusiveMaximum": "below {:g}",
}


def list_tables(schema: Mapping[str, Any]) -> dict[str, str]:
    """Return where each table of the schema stands in a file, in the file's order; where it is first, of several."""
    places: dict[str, str] = {}

    def visit(node: Any, place: str) -> None:
        if "$ref" in node:
            name = node["$ref"].rpartition("/")[2]
            if name not in places:
                places[name] = place
                visit(schema["$defs"][name], place)
        for key, inner in node.get("properties", {}).items():
            visit(inner, f"{place}.{key}" if place else key)
        for inner in [*node.get("allOf", ()), *node.get("anyOf", ()), *node.get("oneOf", ()), *([node["items"]] if "items" in node else ())]:
            visit(inner, place)
        if (entry := find_entry(node)) is not None:
            visit(entry, f"{place}.NAME")

    visit(schema, "")
    return places


def find_entry(node: Mapping[str, Any]) -> Any:
    """Return what each entry of a table by name is; None of another."""
    patterns = node.get("patternProperties", {})
    named = node.get("additionalProperties")
    return next(iter(patterns.values()), named if isinstance(named, dict) else None)


def describe_value(node: Mapping[str, Any], places: Mapping[str, str]) -> str:
    """Return in words what a key may be."""
    if "allOf" in node:  # how older versions of pydantic put a default beside a reference
        return describe_value(node["allOf"][0], places)
    if "$ref" in node:
        place = places[node["$ref"].rpartition("/")[2]]
        return f"[table](#{place.replace('.', '').lower()})"
    if "anyOf" in node or "oneOf" in node:
        parts = [
            describe_value(part, places) for part in node.get("anyOf") or node["oneOf"] if part.get("type") != "null"
        ]
        return " or ".join(dict.fromkeys(parts))
    if "enum" in node or "const" in node:
        return " or ".join(f"`{json.dumps(value)}`" for value in node.get("enum") or [node["const"]])
    if node.get("type") == "array":
        if "prefixItems" in node:
            return "[low, high]"
        return f"list of {describe_value(node['items'], places)}"
    if (entry := find_entry(node)) is not None:
        return f"by name: {describe_value(entry, places)}"
    ends = [words.format(node[end]) for end, words in ENDS.items() if end in node]
    unit = node.get("unit", "")
    return ", ".join([KINDS[node["type"]], *([unit] if unit else []), *([" ".join(ends)] if ends else [])])


def format_rows(table: Mapping[str, Any], places: Mapping[str, str]) -> Iterator[str]:
    """Yield the rows of a table of keys; not of older names."""
    yield "| key | value | left out | meaning |"
    yield "|---|---|---|---|"
    required = table.get("required", ())
    for key, node in sorted(table["properties"].items(), key=lambda row: row[0] not in required):
        if node.get("deprecated"):
            continue
        default = node.get("default")
        left_out = "required" if key in required else ""
        if default not in (None, [], {}) and not isinstance(default, dict):
            left_out = f"`{json.dumps(default)}`"
        value = describe_value(node, places)
        if "unit" in node and "anyOf" in node:
            value += f", {node['unit']}"
        text = re.sub(r"^[a-z](?=[a-z]+ )", lambda first: first[0].upper(), node.get("description", ""))
        text = text.replace("|", "\\|").replace("<", "&lt;")
        yield f"| `{key}` | {value} | {left_out} | {text} |"


def format_page() -> str:
    """Return the page."""
    schema = json_schema()
    places = list_tables(schema)
    parts = [HEAD, "## Top level", "\n".join(format_rows(schema, places))]
    for name, place in places.items():
        table = schema["$defs"][name]
        if "properties" not in table:
            continue
        about = table.get("description", "").replace("\n", " ").replace("|", "\\|")
        heading = f"## {place}"
        parts += [*([heading] if heading not in parts else []), about, "\n".join(format_rows(table, places))]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


if __name__ == "__main__":
    PAGE.write_text(format_page(), encoding="utf-8")
