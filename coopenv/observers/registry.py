"""Observers by name: of this package, registered in the program, and of installed packages.

An observer is a class, or a function of a setup, that runs on the host (`contract.Observer`), or it has kernels
(`coopenv.world.embedded.Embedded`), which run in worlds and, for one vehicle, on the host as well; or it has both.
A package offers its own under the entry point group `coopenv.observers`. An observer in a file or module of the user
is named by its import path: `mine.py:Mine` or `package.module:Mine`.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from coopenv.base.errors import CoopenvError, ScenarioError, shown, suggest
from coopenv.base.installation import absolute_reference, check_reference, install_command, is_reference, load_reference
from coopenv.base.plugins import loaded, offered, own

if TYPE_CHECKING:
    from coopenv.observers.contract import Factory
    from coopenv.world.embedded import Embedded


@dataclass(frozen=True)
class ZooEntry:
    """An observer of this package; its modules load on first use."""

    plugin: str  # module and class, or function of a setup; the first sentence of its docstring stands in tables
    kernels: str = ""  # module and `Embedded`; empty: it runs on the host only
    needs: str = ""  # module of the extra `bench` without which it does not run
    of_robots: bool = False  # whether it is that of a recording of robots where none is named
    covariance: bool = True  # whether its P is meant as a covariance, and is no matrix of gains
    package: str = "coopenv.observers"  # of its modules


ZOO = {
    "dead_reckoning": ZooEntry("pose_filters:DeadReckoning", "riccati:DEAD_RECKONING"),
    "p3p": ZooEntry("pose_filters:PerspectivePoints"),
    "riccati": ZooEntry("riccati:riccati", "riccati:RICCATI", covariance=False),
    "hamel_samson": ZooEntry("pose_filters:HamelSamson", covariance=False),
    "mekf": ZooEntry("pose_filters:Mekf"),
    "mekf_covariance": ZooEntry("pose_filters:MekfCovariance"),
    "mekf_covariance_ungated": ZooEntry("pose_filters:MekfCovarianceUngated"),
    "covariance_intersection": ZooEntry("covariance_intersection:CovarianceIntersection"),
    "split_covariance_intersection": ZooEntry("covariance_intersection:SplitCovarianceIntersection"),
    "pairwise": ZooEntry("schmidt_kalman:Pairwise"),
    "schmidt_kalman": ZooEntry("schmidt_kalman:SchmidtKalman"),
    "schmidt_calibrating": ZooEntry("schmidt_kalman:SchmidtCalibrating"),
    "schmidt_kalman_individual": ZooEntry("schmidt_kalman:SchmidtKalmanIndividual"),
    "self_calibrating": ZooEntry("self_calibrating:SelfCalibrating", of_robots=True),
    "iterated_ekf": ZooEntry("pose_filters:IteratedEkf"),
    "left_invariant": ZooEntry("pose_filters:LeftInvariant"),
    "right_invariant": ZooEntry("pose_filters:RightInvariant"),
    "distributed_invariant": ZooEntry("covariance_intersection:DistributedInvariant"),
    "ukf": ZooEntry("pose_filters:Ukf"),
    "factor_graph": ZooEntry("factor_graph:FactorGraph", needs="gtsam"),
    "robust": ZooEntry("robust.observer:robust", "robust.observer:ROBUST"),
    "centralised": ZooEntry("centralised:Centralised"),
    "first_estimates_ekf": ZooEntry("centralised:FirstEstimatesEkf"),
    "observability_constrained_ekf": ZooEntry("centralised:ObservabilityConstrainedEkf"),
    "belief_propagation": ZooEntry("belief_propagation:BeliefPropagation"),
    "smoother": ZooEntry("smoother:Smoother"),
    "fixed_lag_smoother": ZooEntry("smoother:FixedLagSmoother"),
}
"""Observers of this package by name; `zoo` has those of coopenv's guests, too."""

REPLACED = {"planar_ekf": "mekf_covariance", "planar_robust": "self_calibrating"}
"""Former names of observers, to be removed in 0.10, and the observers that replace them."""


GROUP = "coopenv.observers"

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


def zoo() -> dict[str, ZooEntry]:
    """Return the observers of coopenv by name; guests offer theirs as entry points."""
    return ZOO | {name: loaded(point, "observer") for name, point in own(GROUP).items()}


def observer_of_robots() -> str:
    """Return the name of the observer of a recording of robots, which has no scenario that names one."""
    return next(name for name, row in zoo().items() if row.of_robots)


class RegisteredObserver(NamedTuple):
    """A registered observer: a class or function, kernels, or both."""

    factory: Factory | None
    embedded: Embedded | None


_registered: dict[str, RegisteredObserver] = {}
_places: dict[str, str] = {}  # import paths of those in `_registered`; empty: given as a class
_listed: set[str] = set()  # names in `_registered` that the user has registered


def register(name: str, factory: Factory | None = None, *, embedded: Embedded | None = None) -> None:
    """Register an observer by name in this program.

    Args:
        name: up to 64 letters, digits and `_.-`, a letter first, as scenarios and the command line take it.
        factory: class, or function of a setup; None: made of the kernels.
        embedded: its kernels, for worlds that run it without leaving the device.

    Raises:
        CoopenvError: it is no such name, taken by another observer, or there is neither.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise CoopenvError(
            f"an observer's name is a letter and then letters, digits or any of _.-, at most 64, got {shown(name)}"
        )
    if factory is not None and not callable(factory):
        raise CoopenvError(f"observer '{name}': expected a class or function, got {shown(factory)}")
    if (factory is None and embedded is None) or (embedded is not None and not _has_kernels(embedded)):
        raise CoopenvError(f"observer '{name}': expected a class, a function or an Embedded, got {shown(embedded)}")
    row = RegisteredObserver(factory, embedded)
    if name in zoo() or _registered.get(name, row) != row:
        raise CoopenvError(f"an observer named '{name}' exists already")
    _registered[name] = row
    _listed.add(name)


def _has_kernels(observer: Any) -> bool:
    if observer is None or isinstance(observer, str) or callable(observer):  # so Warp is not loaded for nothing
        return False
    from coopenv.world.embedded import Embedded

    return isinstance(observer, Embedded)


def _row(observer: Any) -> RegisteredObserver:
    return RegisteredObserver(None, observer) if _has_kernels(observer) else RegisteredObserver(observer, None)


def current(name: str) -> str:
    """Return the name of an observer; a former name emits a DeprecationWarning and gives that of the successor."""
    if name not in REPLACED or name in _registered:
        return name
    successor = REPLACED[name]
    warnings.warn(f"observer '{name}' is now '{successor}'", DeprecationWarning, stacklevel=3)
    return successor


def named(observer: str | Factory) -> str:
    """Return the name of an observer; a class or an import path is registered by the name of the class.

    If another observer has that name, the name of the file or module precedes it: `mine.Riccati`. A CoopenvError means
    that the import path has no observer, that it has no name, or that both names are taken.
    """
    if isinstance(observer, list | tuple) or (isinstance(observer, str) and "," in observer):
        raise CoopenvError(f"observer {shown(observer)}: one at a time; several: coopenv.compare")
    if isinstance(observer, str) and not is_reference(observer):
        return current(observer)
    place, found = (absolute_reference(observer), _loaded(observer)) if isinstance(observer, str) else ("", observer)
    row = _row(found)
    name = row.embedded.name if row.embedded is not None else place.rpartition(":")[2] or getattr(found, "__name__", "")
    if not (row.embedded or callable(found)) or not NAME.fullmatch(name):
        raise CoopenvError(f"observer {shown(found)}: expected a name, or a class or function that has one")
    module = Path(place.rpartition(":")[0]).stem if place else _origin(row)[0]
    full = f"{module.rpartition('.')[2].strip('_')}.{name}"  # main.NAME in a notebook
    for short in (name, full):
        replaced = _registered.get(short)
        if replaced == row:
            return short
        again = replaced is not None and _origin(replaced) == _origin(row)  # edited and loaded once more
        if again or (replaced is None and short not in list_observers()):
            _registered[short], _places[short] = row, place
            return short
    raise CoopenvError(f"observers named '{name}' and '{full}' exist already: rename the class")


def _origin(row: RegisteredObserver) -> tuple[str, object]:
    code = row.factory if row.embedded is None else row.embedded.parts[0].func
    return str(getattr(code, "__module__", "")), getattr(code, "__qualname__", code)


def portable(name: str) -> str | Factory:
    """Return the argument of `find` for another process, in which nothing is registered."""
    row = _registered.get(name)
    return _places.get(name) or (name if row is None else row.factory or row.embedded)


def list_observers() -> list[str]:
    """Return every known name, without classes and import paths that were merely used."""
    return sorted({*zoo(), *_listed & _registered.keys(), *offered(GROUP)} - REPLACED.keys())


def states_covariance(name: str) -> bool:
    """Return whether an observer's P is meant as a covariance: of the paper's observer it is a matrix of gains."""
    row = zoo().get(name)
    return row is None or row.covariance


def description(name: str) -> str:
    """Return the description of a known observer in one line, or why it cannot be used here."""
    if reason := obstacle(name):
        return reason
    row = zoo().get(name)
    text = _docstring(row) if row else find(name).__doc__
    return " ".join((text or "").split()).partition(". ")[0].rstrip(".")


def _docstring(row: ZooEntry) -> str | None:
    """Return the docstring of a class or function of this package from the source: loading it may take seconds."""
    module, _, name = row.plugin.partition(":")
    spec = find_spec(f"{row.package}.{module}")
    source = Path(str(spec and spec.origin)).read_text(encoding="utf-8")
    kinds = ast.ClassDef | ast.FunctionDef
    [found] = [node for node in ast.parse(source).body if isinstance(node, kinds) and node.name == name]
    return ast.get_docstring(found)


def with_observer(overrides: Mapping[str, Any] | None, observer: str | Factory | None) -> dict[str, Any]:
    """Return dotted keys and the observer's among them.

    Raises:
        ScenarioError: the overrides are no mapping.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ScenarioError(f"overrides must map dotted keys to values, got {type(overrides).__name__}")
    return {**(overrides or {}), **({} if observer is None else {"observer.name": named(observer)})}


def check_known(name: str) -> None:
    """Refuse an unknown name without loading an observer. Raises CoopenvError: unknown, with the known names."""
    if is_reference(name):
        check_reference(name)
    elif name.endswith(".py"):
        raise CoopenvError(f"{name}: name a class or function in it: {name}:Class")
    elif name not in {*_registered, *REPLACED, *(names := list_observers())}:
        raise CoopenvError(f"unknown observer '{name}'{suggest(name, names)}; known: {', '.join(names)}")


def obstacle(name: str) -> str:
    """Return why a known observer cannot be used here, in one line; empty where it can."""
    if row := zoo().get(name):
        module = row.needs
        return f"needs {module}: {install_command('bench')}" if module and find_spec(module) is None else ""
    if name not in _registered:
        try:
            find(name)
        except CoopenvError as error:
            return str(error)
    return ""


def available_names() -> list[str]:
    """Return the names that can be used here."""
    return [name for name in sorted({*list_observers(), *_registered}) if not obstacle(name)]


def find(name: str | Factory) -> Factory:
    """Return the factory of a name or an import path; a class or function itself; for kernels their plug-in.

    Raises:
        CoopenvError: unknown name, a missing dependency, an import that fails, or no factory.
    """
    name = current(name) if isinstance(name, str) else name
    known = zoo().get(name) if isinstance(name, str) else None
    if known:
        if reason := obstacle(str(name)):
            raise CoopenvError(f"observer '{name}' {reason}")
        return _attribute(known.plugin, known.package)
    row = _found(name)
    return row.factory or _attribute("kernel_observer:KernelFactory")(row.embedded)


def find_embedded(name: str) -> Embedded | None:
    """Return the kernels of an observer by name, None where it has none; errors are those of `find`."""
    name = current(name)
    row = zoo().get(name)
    if row is None:
        return _found(name).embedded
    return _attribute(row.kernels, row.package) if row.kernels else None


def _attribute(place: str, package: str = __package__) -> Any:
    return resolve_name(f"{package}.{place}")


def _loaded(reference: str) -> Any:
    found = load_reference(reference)
    if not (callable(found) or _has_kernels(found)):
        raise CoopenvError(f"observer '{reference}': expected a class, a function or an Embedded, got {found!r:.60}")
    return found


def _found(observer: str | Factory) -> RegisteredObserver:
    """Return the observer of a name outside the zoo, of an import path, or an observer itself."""
    if not isinstance(observer, str):
        return _row(observer)
    if is_reference(observer):
        return _row(_loaded(observer))
    if observer in _registered:
        return _registered[observer]
    check_known(observer)
    return _row(loaded(offered(GROUP)[observer], "observer"))
