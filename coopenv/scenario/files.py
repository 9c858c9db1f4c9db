"""Find, read, override and validate scenario files."""

import json
import re
import tomllib
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from coopenv.base.errors import ScenarioError, explained, shown
from coopenv.base.format import plain
from coopenv.base.installation import is_scene, scenario_path
from coopenv.base.sections import MOST_BYTES, TOO_DEEP, Section, read_toml, validated
from coopenv.base.units import TEXTS
from coopenv.scenario.bodies import with_groups
from coopenv.scenario.cosimulators import completed
from coopenv.scenario.own_terms import located
from coopenv.scenario.scenes import MOST_VEHICLES, scene_text
from coopenv.scenario.schema import Scenario
from coopenv.scenario.sites import STREETS_KEY, Streets, with_streets

DEFAULTS_KEY = "vehicle_defaults"
"""A table of the file whose entries hold for every vehicle without its own."""

COUNT_KEY = "count"
"""Key of an entry of `vehicles` that stands for so many equal ones."""
COUNT_OVERRIDE = re.compile(r"vehicles\.(\d+|\*)\.count")
"""Overrides of it, which number the entries of the file, other ones the vehicles that they stand for."""

OVERRIDES = "overrides"  # where a field stands that an override has made wrong

ScenarioLike = str | Path | Mapping[str, Any] | Scenario
"""A scenario, its name (`facade`, `lane:20`), its TOML file, or the contents of such a file."""


@explained
def load_scenario(name_or_path: ScenarioLike, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and apply dotted overrides; `scenario | {"noise.enabled": False}` does the same.

    `scenario["noise.enabled"]` is the value of a key, `scenario.model_dump_json()` all of them as JSON.

    Args:
        name_or_path: file stem of `envs/`, a scene such as `lane:20`, the path of a TOML file, a dict of what such a
            file holds, or a scenario.
        overrides: dotted key to value; list entries by index or `*` for all (`vehicles.*.goal.radius`).

    Raises:
        UnknownEnvironmentError: no such environment.
        ScenarioError: the file or an override does not describe a possible world.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ScenarioError(f"overrides must map dotted keys to values, got {type(overrides).__name__}")
    if isinstance(name_or_path, Scenario):
        if not overrides:
            return name_or_path
        raw = name_or_path.model_dump(mode="json", exclude_unset=True)
        override(raw, overrides)
        return parse_scenario(located(raw, Path.cwd()), OVERRIDES)
    if not isinstance(name_or_path, str | Path | Mapping):
        kind = type(name_or_path).__name__
        has_one = isinstance(getattr(name_or_path, "scenario", None), Scenario)
        kind += " (did you mean its attribute scenario?)" if has_one else ""
        raise ScenarioError(f"environment: expected a name, a path, a dict of its keys or a Scenario, got {kind}")
    path = Path("scenario")
    try:
        if isinstance(name_or_path, Mapping):
            raw = located({key: _data(value) for key, value in name_or_path.items()}, Path.cwd())
        elif is_scene(str(name_or_path)):
            path = Path(str(name_or_path))
            raw = tomllib.loads(scene_text(str(name_or_path)))
        else:
            path = scenario_path(name_or_path)
            raw = located(read_toml(path, ScenarioError, path.name), path.parent)
        given = overrides or {}
        counts = {key: value for key, value in given.items() if COUNT_OVERRIDE.fullmatch(str(key))}
        override(raw, counts)
        repeat_vehicles(raw, path.name)
        override(raw, {key: value for key, value in given.items() if key not in counts})
        repeat_vehicles(raw, OVERRIDES)
        raw = located(raw, Path.cwd())  # those of overrides
        return parse_scenario(with_streets(apply_vehicle_defaults(raw, path.name), path.name), path.name)
    except RecursionError:
        raise ScenarioError(f"{path.name}: {TOO_DEEP}") from None
    except ScenarioError as error:
        of_file = f"{path.name}: "
        if overrides and str(error).startswith(of_file):
            with warnings.catch_warnings(action="ignore"):
                load_scenario(name_or_path)  # raises its own error if the overrides are not to blame
            raise ScenarioError(f"{OVERRIDES}: {str(error).removeprefix(of_file)}") from None
        raise


Scenario.__or__ = load_scenario  # type: ignore[assignment,method-assign]
Scenario.__replace__ = lambda self, **changes: load_scenario(self, changes)


def _data(value: Any) -> Any:
    """Return a copy of an entry, sections and their lists as plain data."""
    if isinstance(value, dict):
        return {key: _data(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_data(entry) for entry in value]
    return value.model_dump(mode="json", exclude_unset=True) if isinstance(value, Section) else value


def scenario_name(name_or_path: ScenarioLike) -> str:
    """Return the name of a scenario in results: the stem of its file, the name of a scene; without these its title."""
    if isinstance(name_or_path, str | Path):
        return Path(name_or_path).stem
    title = name_or_path.title if isinstance(name_or_path, Scenario) else name_or_path.get("title", "scenario")
    return re.sub(r"[^A-Za-z0-9._-]+", "_", str(title)).strip("_") or "scenario"


def parse_scenario(raw: Mapping[str, Any], where: str) -> Scenario:
    """Validate plain data; `where` names its origin in the error.

    Raises:
        ScenarioError: one line that names the field and, for unknown keys, the nearest valid one.
    """
    try:
        # Through JSON, where the strict mode refuses "5" and true for a number but takes lists for tuples.
        text = json.dumps(with_groups(completed(raw)), default=plain)
    except (TypeError, ValueError) as error:  # keys that are no text, tables within themselves, thousands of digits
        raise ScenarioError(f"{where}: {error}") from None
    except RecursionError:
        raise ScenarioError(f"{where}: {TOO_DEEP}") from None
    return validated(Scenario, text, where, ScenarioError)


def repeat_vehicles(raw: dict[str, Any], where: str) -> None:
    """Replace vehicles with a count by so many, in place. Raises ScenarioError: a count is no such number."""
    repeated: list[Any] = []
    for i, given in enumerate(raw["vehicles"] if isinstance(raw.get("vehicles"), list) else ()):
        vehicle, count = given, 1
        if isinstance(given, dict) and COUNT_KEY in given:
            vehicle = {**given}
            count = vehicle.pop(COUNT_KEY)
        if type(count) is not int or not 1 <= count <= MOST_VEHICLES:
            expected = f"expected a whole number 1 to {MOST_VEHICLES}, got {shown(count)}"
            raise ScenarioError(f"{where}: vehicles.{i}.{COUNT_KEY}: {expected}")
        _check_size(vehicle, count, f"{where}: vehicles.{i}.{COUNT_KEY}")
        repeated += [vehicle, *(_data(vehicle) for _ in range(count - 1))]
    if repeated:
        raw["vehicles"] = repeated


def _check_size(table: Any, times: int, where: str) -> None:
    """Refuse a table that stands for so many that they would take more than a file may."""
    size = 0
    with suppress(TypeError, ValueError):  # what is no data is refused later
        size = times * len(json.dumps(table, default=plain)) if times > 1 else 0
    if size > 2 * MOST_BYTES:
        raise ScenarioError(f"{where}: {times} times its length is {size >> 20} MiB, over {2 * MOST_BYTES >> 20} MiB")


def apply_vehicle_defaults(raw: Mapping[str, Any], where: str = "scenario") -> dict[str, Any]:
    """Merge the table `vehicle_defaults` under every entry of `vehicles`. Raises ScenarioError: it is not a table."""
    filled = dict(raw)
    defaults = filled.pop(DEFAULTS_KEY, {})
    if not isinstance(defaults, dict):
        raise ScenarioError(f"{where}: {DEFAULTS_KEY}: must be a table, got {shown(defaults)}")
    vehicles = filled.get("vehicles")
    if isinstance(vehicles, list):
        _check_size(defaults, len(vehicles), f"{where}: {DEFAULTS_KEY}")
        filled["vehicles"] = [_with_defaults(defaults, v) if isinstance(v, dict) else v for v in vehicles]
    return filled


def _with_defaults(defaults: Mapping[str, Any], vehicle: Mapping[str, Any]) -> dict[str, Any]:
    result: dict[str, Any] = merged(defaults, vehicle)
    motion = result.get("motion")
    if isinstance(motion, dict) and motion.get("kind") == "waypoints" and "initial_pose" not in vehicle:
        result.pop("initial_pose", None)  # such a motion starts at its first waypoint
    return result


def merged(under: Any, over: Any) -> Any:
    """Return `over` on top of `under`; tables are merged unless they are of different kinds."""
    if (
        not (isinstance(under, Mapping) and isinstance(over, Mapping))
        or over.get("kind", kind := under.get("kind")) != kind
    ):
        return over
    return {**under, **{key: merged(under.get(key), value) for key, value in over.items()}}


def override(raw: Any, overrides: Mapping[str, Any]) -> None:
    """Set dotted keys in nested plain data, in place; a table is merged into an existing one."""
    for key, value in overrides.items():
        _descend(raw, str(key).split("."), value, str(key))


def _descend(node: Any, path: list[str], value: Any, key: str, parent: str = "") -> None:
    head, rest = path[0], path[1:]
    if not isinstance(node, list | dict):
        raise ScenarioError(f"override {shown(key)}: {shown(head)} lies below a plain value")
    places: Iterable[Any] = _indices(node, head, key, parent) if isinstance(node, list) else [head]
    for place in places:
        below = node.get(place, {} if rest else None) if isinstance(node, dict) else node[place]
        if rest:
            node[place] = dict(below) if isinstance(below, dict) else below
            _descend(node[place], rest, value, key, head)
        else:
            node[place] = merged(below, value) if isinstance(node, dict) else value


def _indices(node: list[Any], head: str, key: str, parent: str) -> Iterable[int]:
    if head == "*":
        return range(len(node))
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in node]
    if head in names:
        return [names.index(head)]
    number = head.removeprefix("vehicle_") if parent == "vehicles" else head
    whole = number.isascii() and number.isdigit() and len(number) < 10
    index = int(number) - (1 if head != number else 0) if whole else -1
    if not 0 <= index < len(node):
        there = f"(there are {len(node)}; 0..{len(node) - 1} or *)"
        raise ScenarioError(f"override {shown(key)}: no entry {shown(head)} {there}")
    return [index]


REFERENCE = re.compile(r"#/\$defs/(\w+)")


def schema_text() -> str:
    """Return the schema of a file: that of `Scenario`, and the tables and keys that the loader works out.

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
    schema["required"].remove("landmarks")  # which SUMO's files may have
    schema["properties"][STREETS_KEY] = Streets.model_json_schema()
    schema["properties"]["vehicles"]["items"] = {"$ref": "#/$defs/PartialVehicle"}
    about = "Of an entry of `vehicles`: so many equal ones."
    number = {"type": "integer", "minimum": 1, "maximum": MOST_VEHICLES, "description": about}
    definitions["PartialVehicle"]["properties"][COUNT_KEY] = number
    schema["properties"][DEFAULTS_KEY] = {
        "$ref": "#/$defs/PartialVehicle",
        "description": "Entries of every vehicle without its own.",
    }
    used = _reachable(_references(schema["properties"]), definitions)
    definitions["Quantity"] = {"type": ["string", "number"], "pattern": r"^\s*[+-]?\.?\d"}
    schema["$defs"] = {name: definitions[name] for name in sorted({*used, "Quantity"})}
    whole = json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **schema})
    shared = whole.replace(json.dumps(TEXTS)[1:-1], '"$ref": "#/$defs/Quantity"')
    return json.dumps(json.loads(shared), indent=2) + "\n"


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
