"""Observers by name: those of this package, those registered in the program, and those of installed packages.

An observer is a class, or a function of a setup, that runs on the host (`contract.Observer`), or it has kernels
(`coopenv.world.embedded.Embedded`), which run in worlds and, for one vehicle, on the host as well; or it has both.
A package offers its own under the entry point group `coopenv.observers`. What is in a file or module of the user's own
is named by its place: `mine.py:Mine` or `package.module:Mine`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from coopenv.base.errors import CoopenvError, error_text, shown, suggest
from coopenv.base.user_code import absolute, is_reference, load

if TYPE_CHECKING:
    from coopenv.observers.contract import Factory
    from coopenv.world.embedded import Embedded


@dataclass(frozen=True)
class Entry:
    """Where an observer stands in this package; nothing is loaded before it is asked for."""

    plugin: str  # module and class, or function of a setup
    about: str  # one line for tables
    kernels: str = ""  # module and `Embedded`; empty: it runs on the host only
    needs: str = ""  # module of the extra `bench` without which it does not run
    in_space: bool = True  # whether it is meant for vehicles in space
    on_a_plane: bool = True
    """Whether it is meant for robots on a plane whose odometry is their commands (`Setup.planar`)."""
    kernels_on_a_plane: bool = True  # whether its kernels are those of the plug-in there
    covariance: bool = True  # whether its P is meant as a covariance, and is no matrix of gains


ZOO = {
    "dead_reckoning": Entry(
        "single_frame:DeadReckoning", "Adds up odometry and sends nothing", "riccati.kernels:DEAD_RECKONING"
    ),
    # on a plane bearings to three points say more than a pose needs
    "p3p": Entry("single_frame:PerspectivePoints", "A pose per frame from three bearings, no memory", on_a_plane=False),
    "riccati": Entry(
        "riccati.kernels:riccati",
        "The paper's observer, with the scenario's gains",
        "riccati.kernels:RICCATI",
        covariance=False,
    ),
    "hamel_samson": Entry(
        "error_state_filters:HamelSamson", "The paper's observer with landmarks alone", covariance=False
    ),
    "mekf": Entry("error_state_filters:Mekf", "Error-state filter; takes received positions as exact"),
    "mekf_covariance": Entry(
        "error_state_filters:MekfCovariance", "Error-state filter; weighs received positions by covariance"
    ),
    "mekf_covariance_ungated": Entry(
        "error_state_filters:MekfCovarianceUngated", "Error-state filter that accepts every bearing"
    ),
    "covariance_intersection": Entry(
        "covariance_intersection:CovarianceIntersection", "Kalman filter; neighbours by covariance intersection"
    ),
    "split_covariance_intersection": Entry(
        "covariance_intersection:SplitCovarianceIntersection", "Kalman filter; neighbours by split intersection"
    ),
    "pairwise": Entry("schmidt_kalman:Pairwise", "Keeps cross-covariances pair by pair"),
    "schmidt_kalman": Entry("schmidt_kalman:SchmidtKalman", "Considers neighbours with cross-covariances"),
    "iterated_ekf": Entry(
        "error_state_filters:IteratedEkf", "Error-state filter that iterates corrections; sends covariances"
    ),
    "left_invariant": Entry("error_state_filters:LeftInvariant", "Invariant filter, left error; sends covariances"),
    "right_invariant": Entry("error_state_filters:RightInvariant", "Invariant filter, right error; sends covariances"),
    "ukf": Entry("error_state_filters:Ukf", "Unscented (sigma-point) filter; sends covariances"),
    "factor_graph": Entry(
        "factor_graph:FactorGraph", "Factor graph smoothed at key frames; sends covariances", needs="gtsam"
    ),
    "planar_ekf": Entry("planar.plugin:PlanarEkf", "Extended Kalman filter of x, y and heading", in_space=False),
    "planar_robust": Entry(
        "planar.plugin:PlanarRobust",
        "Calibrates its odometry online; fuses neighbours by split covariance intersection",
        in_space=False,
    ),
    "robust": Entry(
        "robust.observer:robust",
        "This project's observer for vehicles in space: several hypotheses, gates",
        "robust.observer:ROBUST",
        on_a_plane=False,
        kernels_on_a_plane=False,
    ),
    "robust_joint": Entry(
        "robust.joint_fusion:robust_joint",
        "The robust observer with larger, joint messages, for vehicles in space",
        "robust.joint_fusion:ROBUST_JOINT",
        on_a_plane=False,
        kernels_on_a_plane=False,
    ),
    "centralised": Entry("centralised:Centralised", "One filter over all vehicles and all measurements"),
}
"""By name."""


GROUP = "coopenv.observers"

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")


class Registered(NamedTuple):
    """What a program has registered under a name, as a class or function, with kernels, or both."""

    factory: Factory | None
    embedded: Embedded | None


_registered: dict[str, Registered] = {}
_places: dict[str, str] = {}  # where those of `_registered` stand that are named by their place


def register(name: str, factory: Factory | None = None, *, embedded: Embedded | None = None) -> None:
    """Make an observer known by name in this program.

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
    row = Registered(factory, embedded)
    if name in ZOO or _registered.get(name, row) != row:
        raise CoopenvError(f"an observer named '{name}' exists already")
    _registered[name] = row


def _has_kernels(observer: Any) -> bool:
    if observer is None or isinstance(observer, str) or callable(observer):  # so Warp is not loaded for nothing
        return False
    from coopenv.world.embedded import Embedded

    return isinstance(observer, Embedded)


def _row(observer: Any) -> Registered:
    return Registered(None, observer) if _has_kernels(observer) else Registered(observer, None)


def named(observer: str | Factory) -> str:
    """Return the name of an observer; a class or a place in code becomes known by the name of the class.

    Where another observer has that name, the name of its file or module is put before it: `mine.Riccati`. A
    CoopenvError says that there is none at that place, that it is no observer or has no name, or that both are taken.
    """
    if isinstance(observer, str) and not is_reference(observer):
        return observer
    place, found = (absolute(observer), _loaded(observer)) if isinstance(observer, str) else ("", observer)
    row = _row(found)
    name = row.embedded.name if row.embedded is not None else place.rpartition(":")[2] or getattr(found, "__name__", "")
    if not (row.embedded or callable(found)) or not NAME.fullmatch(name):
        raise CoopenvError(f"observer {shown(found)}: expected a name, or a class or function that has one")
    module = Path(place.rpartition(":")[0]).stem if place else _origin(row)[0]
    full = f"{module.rpartition('.')[2]}.{name}"
    for short in (name, full):
        replaced = _registered.get(short)
        if replaced == row:
            return short
        again = replaced is not None and _origin(replaced) == _origin(row)  # edited and loaded once more
        if again or short not in observer_names():
            _registered.pop(short, None)
            register(short, row.factory, embedded=row.embedded)
            _places[short] = place
            return short
    raise CoopenvError(f"observers named '{name}' and '{full}' exist already: rename the class")


def _origin(row: Registered) -> tuple[str, object]:
    code = row.factory if row.embedded is None else row.embedded.estimate.func
    return str(getattr(code, "__module__", "")), getattr(code, "__qualname__", code)


def portable(name: str) -> str | Factory:
    """Return what `find` takes in another process, which does not know what was registered in this one."""
    row = _registered.get(name)
    return _places.get(name) or (name if row is None else row.factory or row.embedded)


def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def observer_names() -> list[str]:
    """Return every known name."""
    return sorted({*ZOO, *_registered, *_installed()})


def states_covariance(name: str) -> bool:
    """Return whether an observer's P is meant as a covariance: of the paper's observer it is a matrix of gains."""
    return name not in ZOO or ZOO[name].covariance


def description(name: str) -> str:
    """Return what a known observer is in one line, or why it cannot be used here."""
    if reason := obstacle(name):
        return reason
    if name in ZOO:
        return ZOO[name].about
    return " ".join((find(name).__doc__ or "").split()).partition(". ")[0].rstrip(".")


def check_known(name: str) -> None:
    """Refuse an unknown name without loading what is behind one. Raises CoopenvError: unknown, with the names known."""
    if not is_reference(name) and name not in (names := observer_names()):
        raise CoopenvError(f"unknown observer '{name}'{suggest(name, names)}; known: {', '.join(names)}")


def obstacle(name: str) -> str:
    """Return why a known observer cannot be used here, in one line; empty where it can."""
    if name in ZOO:
        module = ZOO[name].needs
        return f"needs {module}: pip install '.[bench]'" if module and find_spec(module) is None else ""
    if name not in _registered:
        try:
            find(name)
        except CoopenvError as error:
            return str(error)
    return ""


def available_names(planar: bool | None = None) -> list[str]:
    """Return the names that can be used here; `planar`: only those for robots on a plane, or for vehicles in space."""
    both = planar is None
    strangers = {name for name, row in ZOO.items() if not (both or (row.on_a_plane if planar else row.in_space))}
    return [name for name in observer_names() if name not in strangers and not obstacle(name)]


def find(name: str | Factory) -> Factory:
    """Return the factory of a name or of a place in code, a class or function as it is, and one made of kernels.

    Raises:
        CoopenvError: unknown name, or what it needs is not installed, or it cannot be loaded, or is no factory.
    """
    if isinstance(name, str) and name in ZOO:
        if reason := obstacle(name):
            raise CoopenvError(f"observer '{name}' {reason}")
        return _attribute(ZOO[name].plugin)
    row = _found(name)
    return row.factory or _attribute("kernel_observer:KernelFactory")(row.embedded)


def find_embedded(name: str, planar: bool = False) -> Embedded | None:
    """Return the kernels of an observer by name, None where it has none; errors are those of `find`.

    `planar` is for robots on a plane whose odometry is their commands.
    """
    if name not in ZOO:
        return _found(name).embedded
    row = ZOO[name]
    return _attribute(row.kernels) if row.kernels and (row.kernels_on_a_plane or not planar) else None


def _attribute(place: str) -> Any:
    return resolve_name(f"{__package__}.{place}")


def _loaded(reference: str) -> Any:
    found = load(reference)
    if not (callable(found) or _has_kernels(found)):
        raise CoopenvError(f"observer '{reference}': expected a class, a function or an Embedded, got {found!r:.60}")
    return found


def _found(observer: str | Factory) -> Registered:
    """Return what stands behind a name that is not of the zoo, a place in code, or an observer itself."""
    if not isinstance(observer, str):
        return _row(observer)
    if is_reference(observer):
        return _row(_loaded(observer))
    if observer in _registered:
        return _registered[observer]
    check_known(observer)
    point = _installed()[observer]
    try:
        return _row(point.load())
    except (Exception, SystemExit) as error:  # anybody's code
        raise CoopenvError(f"observer '{observer}' ({point.value}) cannot be loaded: {error_text(error)}") from error
