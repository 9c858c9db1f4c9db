"""Parts that installed packages add to coopenv, as entry points: observers, sources and commands.

Guests in coopenv itself are added in the same way. In a clone they are those of its `pyproject.toml`, because the
metadata of an editable installation may be older.
"""

import sys
import tomllib
from functools import cache
from importlib import metadata
from importlib.metadata import EntryPoint
from itertools import islice
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from coopenv.base.errors import CoopenvError, error_text


def offered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; a name of coopenv itself cannot be taken by another package."""
    others = {point.name: point for point in reversed(_others(tuple(sys.path))) if point.group == group}
    return {**own(group), **others, **own(group)}


def own(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of coopenv itself, without a look at other packages."""
    return {point.name: point for point in _own() if point.group == group}


def loaded(point: EntryPoint, what: str) -> Any:
    """Return the object of an entry point. Raises CoopenvError: its code fails; `what` it is begins the error."""
    try:
        return point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # foreign code
        raise CoopenvError(f"{what} '{point.name}' ({point.value}) cannot be loaded: {error_text(error)}") from error


def call(place: str, *arguments: Any, **options: Any) -> Any:
    """Return the result of a function of a place, `module:name`. Raises CoopenvError: another package's code fails."""
    try:
        return resolve_name(place)(*arguments, **options)
    except Exception as error:
        if isinstance(error, CoopenvError) or place.startswith("coopenv."):
            raise
        raise CoopenvError(f"{place} fails: {error_text(error)}") from error


@cache
def _own() -> list[EntryPoint]:
    clone = Path(__file__).resolve().parents[2] / "pyproject.toml"
    project = tomllib.loads(clone.read_text(encoding="utf-8")).get("project", {}) if clone.is_file() else {}
    if project.get("name") != "coopenv":
        return [point for found in islice(metadata.distributions(name="coopenv"), 1) for point in found.entry_points]
    groups = project["entry-points"].items()
    return [EntryPoint(name, value, group) for group, points in groups for name, value in points.items()]


@cache
def _others(path: tuple[str, ...]) -> list[EntryPoint]:
    """Return the points of all packages on a path; a scan of many packages takes some 10 ms."""
    packages = [one for one in metadata.distributions() if "[coopenv." in (one.read_text("entry_points.txt") or "")]
    return [point for package in packages for point in package.entry_points]
