"""Observers by name: the zoo, those registered in the program, and those of installed packages.

A package offers its own under the entry point group `coopenv.observers`. What is in a file or module of the user's own
is named by its place: `mine.py:Mine` or `package.module:Mine`.
"""

from __future__ import annotations

import re
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import cast

from coopenv.errors import CoopenvError, suggest
from coopenv.observers.contract import Factory
from coopenv.user_code import absolute, is_reference, load, one_line

GROUP = "coopenv.observers"

ZOO = {
    "dead_reckoning": "dead_reckoning:DeadReckoning",
    "p3p": "single_frame:PerspectivePoints",
    "riccati": "riccati.plugin:Riccati",
    "hamel_samson": "hamel_samson:HamelSamson",
    "mekf": "mekf:Mekf",
    "mekf_covariance": "mekf_covariance:MekfCovariance",
    "covariance_intersection": "covariance_intersection:CovarianceIntersection",
    "left_invariant": "left_invariant:LeftInvariant",
    "right_invariant": "right_invariant:RightInvariant",
    "ukf": "ukf:Ukf",
    "factor_graph": "factor_graph:FactorGraph",
    "planar_ekf": "planar.plugin:PlanarEkf",
    "robust": "robust.plugin:robust",
    "robust_joint": "robust.plugin:robust_joint",
    "centralised": "centralised:Centralised",
}
"""Name to module and class in this package."""

NEEDS = {"factor_graph": "gtsam"}
"""Members of the zoo that need a module of the extra `bench`."""

ON_A_PLANE = {"planar_ekf"}
"""Members of the zoo for robots on a plane whose odometry is their commands (`Setup.planar`), and for no others."""
IN_SPACE = {"p3p", "robust_joint"}
"""Members that are for all others: on a plane bearings to three points say more than a pose needs, and joint messages
do not exist (`robust_joint` is `robust` there)."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")

_registered: dict[str, Factory] = {}
_places: dict[str, str] = {}
"""Where those of `_registered` stand that are named by their place."""


def register(name: str, factory: Factory) -> None:
    """Make an observer known by name in this program.

    Args:
        name: letters, digits and `_.-`, a letter first, as scenarios and the command line take it.
        factory: class, or function of a setup.

    Raises:
        CoopenvError: it is no such name, taken by another observer, or the factory cannot be called.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise CoopenvError(f"an observer's name is a letter and then letters, digits or any of _.-, got {name!r}")
    if not callable(factory):
        raise CoopenvError(f"observer '{name}': expected a class or function, got {factory!r:.60}")
    if name in ZOO or _registered.get(name, factory) is not factory:
        raise CoopenvError(f"an observer named '{name}' exists already")
    _registered[name] = factory


def named(observer: str | Factory) -> str:
    """Return the name of an observer; a class or a place in code becomes known by the name of the class.

    Where another observer has that name, the name of its file or module is put before it: `mine.Riccati`.

    Args:
        observer: name, which is returned as it is, `file.py:Class`, `package.module:Class`, or a class or function of
            a setup.

    Raises:
        CoopenvError: there is none at that place, it is no observer or has no name, or its names are taken.
    """
    if isinstance(observer, str) and not is_reference(observer):
        return observer
    place, factory = (absolute(observer), find(observer)) if isinstance(observer, str) else ("", observer)
    name = place.rpartition(":")[2] or getattr(factory, "__name__", "")
    if not callable(factory) or not NAME.fullmatch(name):
        raise CoopenvError(f"observer {factory!r:.60}: expected a name, or a class or function that has one")
    module = Path(place.rpartition(":")[0]).stem if place else str(factory.__module__)
    full = f"{module.rpartition('.')[2]}.{name}"
    for short in (name, full):
        if _registered.get(short) is factory:
            return short
        replaced = _registered.get(short)
        again = replaced is not None and _origin(replaced) == _origin(factory)  # edited and loaded once more
        if again or short not in observer_names():
            _registered.pop(short, None)
            register(short, factory)
            _places[short] = place
            return short
    raise CoopenvError(f"observers named '{name}' and '{full}' exist already: rename the class")


def _origin(factory: Factory) -> tuple[object, object]:
    return getattr(factory, "__module__", None), getattr(factory, "__qualname__", factory)


def portable(name: str) -> str | Factory:
    """Return what `find` takes in another process, which does not know what was registered in this one."""
    return _places.get(name) or _registered.get(name, name)


def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def observer_names() -> list[str]:
    """Return every known name."""
    return sorted({*ZOO, *_registered, *_installed()})


def missing(name: str) -> str:
    """Return the module that an observer of the zoo needs and that is not installed; empty where nothing is missing."""
    module = NEEDS.get(name, "")
    return module if module and find_spec(module) is None else ""


def obstacle(name: str) -> str:
    """Return why a known observer cannot be used here, in one line; empty where it can."""
    if module := missing(name):
        return f"needs {module}: pip install '.[bench]'"
    if name not in ZOO and name not in _registered:
        try:
            find(name)
        except CoopenvError as error:
            return str(error)
    return ""


def available_names(planar: bool | None = None) -> list[str]:
    """Return every known name whose modules are installed and, where it is of another package, which can be loaded.

    Args:
        planar: only those that are meant for robots on a plane (True) or for vehicles in space (False).
    """
    strangers: set[str] = set() if planar is None else IN_SPACE if planar else ON_A_PLANE
    return [name for name in observer_names() if name not in strangers and not obstacle(name)]


def find(name: str | Factory) -> Factory:
    """Return the factory of a name or of a place in code; a factory itself as it is.

    Raises:
        CoopenvError: unknown name, or what it needs is not installed, or it cannot be loaded, or is no factory.
    """
    if not isinstance(name, str):
        return name
    if is_reference(name):
        factory = load(name)
        if not callable(factory):
            raise CoopenvError(f"observer '{name}': expected a class or function, got {factory!r:.60}")
        return cast(Factory, factory)
    if missing(name):
        raise CoopenvError(f"observer '{name}' {obstacle(name)}")
    if name in ZOO:
        module, attribute = ZOO[name].split(":")
        return getattr(import_module(f"{__package__}.{module}"), attribute)
    if name in _registered:
        return _registered[name]
    point = _installed().get(name)
    if point is None:
        names = observer_names()
        raise CoopenvError(f"unknown observer '{name}'{suggest(name, names)}; known: {', '.join(names)}")
    try:
        return point.load()
    except (Exception, SystemExit) as error:  # anybody's code
        raise CoopenvError(f"observer '{name}' ({point.value}) cannot be loaded: {one_line(error)}") from error


def is_joint(factory: Factory) -> bool:
    """Return whether a factory builds one observer for all vehicles."""
    return bool(getattr(factory, "joint", False))
