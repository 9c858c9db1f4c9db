"""Parts that installed packages add to coopenv, as entry points: observers, sources and commands.

Guests in coopenv itself are added in the same way. In a clone they are those of its `pyproject.toml`, because the
metadata of an editable installation may be older.
"""

import sys
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from coopenv.base.errors import CoopenvError, error_text


def offered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; a name of coopenv itself cannot be taken by another package."""
    return {**own(group), **_others(tuple(sys.path)).get(group, {}), **own(group)}


def own(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of coopenv itself, without a look at other packages."""
    return {name: EntryPoint(name, value, group) for name, value in _own_groups().get(group, {}).items()}


def loaded(point: EntryPoint, what: str) -> Any:
    """Return the object of an entry point. Raises CoopenvError: its code fails; `what` it is begins the error."""
    try:
        return point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # foreign code
        raise CoopenvError(f"{what} '{point.name}' ({point.value}) cannot be loaded: {error_text(error)}") from error


def call(place: str, what: str, *arguments: Any, **options: Any) -> Any:
    """Return the result of a function or class of a place, `module:name`.

    Raises:
        CoopenvError: another package's code fails; `what` begins the error. A failure of coopenv itself is not changed.
    """
    try:
        return resolve_name(place)(*arguments, **options)
    except CoopenvError:
        raise
    except Exception as error:
        if place.startswith("coopenv."):
            raise
        raise CoopenvError(f"{what} ({place}) fails: {error_text(error)}") from error


@cache
def _own_groups() -> dict[str, dict[str, str]]:
    clone = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if clone.is_file():
        project = tomllib.loads(clone.read_text(encoding="utf-8")).get("project", {})
        if project.get("name") == "coopenv":
            return dict(project.get("entry-points", {}))
    groups: dict[str, dict[str, str]] = {}
    for distribution in metadata.distributions(name="coopenv"):
        for point in distribution.entry_points:
            groups.setdefault(point.group, {}).setdefault(point.name, point.value)
    return groups


@cache
def _others(path: tuple[str, ...]) -> Mapping[str, dict[str, EntryPoint]]:
    """Return the points of all packages on a path; a scan of many packages takes some 10 ms."""
    groups: dict[str, dict[str, EntryPoint]] = {}
    for point in _scan():
        groups.setdefault(point.group, {}).setdefault(point.name, point)
    return groups


def _scan() -> Iterator[EntryPoint]:
    for distribution in metadata.distributions():
        if "[coopenv." in (distribution.read_text("entry_points.txt") or ""):
            yield from distribution.entry_points
