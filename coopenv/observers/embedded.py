"""Observers that run in the world's kernels, by name."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from coopenv.errors import CoopenvError
from coopenv.world.embedded import HOST, Embedded

EMBEDDED = {
    "riccati": "riccati.kernels:RICCATI",
    "dead_reckoning": "riccati.kernels:DEAD_RECKONING",
    "robust": "robust.kernels:ROBUST",
}
"""Name to module and attribute in this package."""

IN_SPACE = {"robust"}
"""Those that have no kernels for robots on a plane, and run on the host there."""

_registered: dict[str, Embedded] = {}


def register_embedded(observer: Embedded) -> None:
    """Make an observer with kernels known by its name in this program, for `observer=` and `observer.name`.

    Raises:
        CoopenvError: the name is taken by another one.
    """
    if observer.name in EMBEDDED or _registered.get(observer.name, observer) is not observer:
        raise CoopenvError(f"an observer with kernels named '{observer.name}' exists already")
    _registered[observer.name] = observer


def find_embedded(name: str, planar: bool = False) -> Embedded:
    """Return the observer of a name, or `HOST` where it has no kernels (for vehicles on a plane)."""
    if name in _registered:
        return _registered[name]
    if name not in EMBEDDED or (planar and name in IN_SPACE):
        return HOST
    module, attribute = EMBEDDED[name].split(":")
    return cast(Embedded, getattr(import_module(f"{__package__}.{module}"), attribute))
