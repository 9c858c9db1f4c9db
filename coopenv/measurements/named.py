"""Users' classes of sensors that a program may run: those that its user has named, and no others.

A log holds the name of a class alone, without a folder. No code runs only because a log names it.
"""

from pathlib import Path

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import is_reference

_references: dict[str, str] = {}  # by the name in logs


def name_in_logs(reference: str) -> str:
    """Return a reference without the folder of its file."""
    place, _, name = reference.rpartition(":")
    return f"{Path(place).name}:{name}" if place.endswith(".py") else reference


def allow(reference: str) -> None:
    """Let logs name a class, `file.py:Class` or `package.module:Class`, as that of a world which this program runs."""
    _references[name_in_logs(reference)] = reference


def reference_of(named: str, sensor: str) -> str:
    """Return the kind of a log's sensor, a user's class by its full reference.

    Raises:
        CoopenvError: a class that the user has not named.
    """
    if not is_reference(named):
        return named
    if named not in _references:
        key = f"--set sensors.{sensor}.kind={named}"
        raise CoopenvError(f"sensor '{sensor}': its class {named} is run only if you name its file: {key}")
    return _references[named]
