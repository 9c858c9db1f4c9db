"""The JSON schema of scenario files, for editors that complete and check TOML while it is written."""

import json
import re
from collections.abc import Mapping
from typing import Any

from coopenv.scenario.files import DEFAULTS_KEY
from coopenv.scenario.schema import Scenario

REFERENCE = re.compile(r"#/\$defs/(\w+)")


def schema_text() -> str:
    """Return the schema of a file: that of `Scenario`, and the table of defaults that the loader merges.

    A vehicle may leave out what the defaults say, and the defaults what every vehicle says. Both are therefore
    checked for their keys and values, but not for completeness.
    """
    schema = Scenario.model_json_schema()
    definitions = schema["$defs"]
    merged = _reachable({"Vehicle"}, json.loads(json.dumps(definitions), object_hook=_without_lists))
    partial = re.compile(rf"#/\$defs/(?=({'|'.join(merged)})\b)")
    for name in merged:
        text = json.dumps({key: value for key, value in definitions[name].items() if key != "required"})
        definitions[f"Partial{name}"] = json.loads(partial.sub("#/$defs/Partial", text))
    schema["properties"]["vehicles"]["items"] = {"$ref": "#/$defs/PartialVehicle"}
    schema["properties"][DEFAULTS_KEY] = {
        "$ref": "#/$defs/PartialVehicle",
        "description": "What every vehicle takes over unless it says otherwise.",
    }
    used = _reachable(_references(schema["properties"]), definitions)
    schema["$defs"] = {name: definitions[name] for name in sorted(used)}
    whole = {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
    return json.dumps(whole, indent=2) + "\n"


def _without_lists(node: dict[str, Any]) -> dict[str, Any]:
    """Leave out entries of lists, which are never merged."""
    return {key: value for key, value in node.items() if key not in ("items", "prefixItems")}


def _references(node: Any) -> set[str]:
    return set(REFERENCE.findall(json.dumps(node)))


def _reachable(names: set[str], definitions: Mapping[str, Any]) -> set[str]:
    """Return these names and those of all definitions that they refer to, directly or not."""
    found: set[str] = set()
    while names:
        found |= names
        names = {below for name in names for below in _references(definitions[name])} - found
    return found
