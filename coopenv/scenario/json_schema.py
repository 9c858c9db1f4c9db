"""The JSON schema of scenario files, for editors that complete and check TOML while it is written."""

from __future__ import annotations

import json
from typing import Any

from coopenv.scenario.files import DEFAULTS_KEY
from coopenv.scenario.schema import Scenario

REFERENCE = "#/$defs/"


def scenario_schema() -> dict[str, Any]:
    """Return the schema of a file: that of `Scenario`, and the table of defaults that the loader merges.

    A vehicle may leave out what the defaults say, and the defaults what every vehicle says. Both are therefore
    checked for their keys and values, but not for completeness.
    """
    schema = Scenario.model_json_schema()
    definitions = schema["$defs"]
    for name in _tables_below("Vehicle", definitions):
        definitions[_partial(name)] = _without_required(definitions[name])
    for name in list(definitions):
        if name.startswith("Partial"):
            definitions[name] = _pointing_to_partials(definitions[name], definitions)
    schema["properties"]["vehicles"]["items"] = {"$ref": REFERENCE + _partial("Vehicle")}
    schema["properties"][DEFAULTS_KEY] = {
        "$ref": REFERENCE + _partial("Vehicle"),
        "description": "What every vehicle takes over unless it says otherwise.",
    }
    schema["$defs"] = {name: definitions[name] for name in sorted(_used(schema, definitions))}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the schema as it stands in `docs/scenario.schema.json`."""
    return json.dumps(scenario_schema(), indent=2) + "\n"


def _partial(name: str) -> str:
    return f"Partial{name}"


def _without_required(definition: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in definition.items() if key != "required"}


def _tables_below(name: str, definitions: dict[str, Any]) -> set[str]:
    """Return `name` and the definitions that it holds as tables; entries of lists are never merged."""
    found, waiting = set(), [name]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += _references(definitions[current].get("properties", {}), into_lists=False)
    return found


def _references(node: Any, into_lists: bool = True) -> list[str]:
    """Return the names of the definitions that a piece of schema refers to."""
    if isinstance(node, list):
        return [name for item in node for name in _references(item, into_lists)]
    if not isinstance(node, dict):
        return []
    here = [node["$ref"].removeprefix(REFERENCE)] if isinstance(node.get("$ref"), str) else []
    skipped = () if into_lists else ("items", "prefixItems")
    return here + [
        name
        for key, value in node.items()
        if key not in ("discriminator", *skipped)
        for name in _references(value, into_lists)
    ]


def _pointing_to_partials(node: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(node, list):
        return [_pointing_to_partials(item, definitions) for item in node]
    if isinstance(node, dict):
        return {key: _pointing_to_partials(value, definitions) for key, value in node.items()}
    if isinstance(node, str) and node.startswith(REFERENCE):
        name = _partial(node.removeprefix(REFERENCE))
        return REFERENCE + name if name in definitions else node
    return node


def _used(schema: dict[str, Any], definitions: dict[str, Any]) -> set[str]:
    found: set[str] = set()
    waiting = _references(schema["properties"])
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += _references(definitions[name])
    return found
