"""Users' own terms: registered by name in a program, or located in a scenario file; see docs/terms.md."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from coopenv.base import installation
from coopenv.base.errors import CoopenvError, shown
from coopenv.base.sections import one_line
from coopenv.motions.table import DRIVES
from coopenv.scenario.cosimulators import COSIMULATORS, FILES
from coopenv.scenario.terms import (
    GROUPS,
    OBSERVATION_FIELDS,
    READING,
    REWARD_TERMS,
    TERMINATION_CONDITIONS,
    USUAL_GROUPS,
    ObservationField,
    Per,
    R,
    Registry,
    Scale,
    Term,
)

SECTIONS: Mapping[str, Registry[Any]] = {
    "observation": OBSERVATION_FIELDS,
    "reward": REWARD_TERMS,
    "termination": TERMINATION_CONDITIONS,
}
"""Parts of a scenario with a table `custom`, and the terms that they may name."""

EVERY = "*"
MODELS = (("dynamics", "model"), ("vehicles", EVERY, "dynamics", "model"))
"""Places of users' own drives in a scenario, those of single vehicles included."""
CODE = (
    *((section, "custom", EVERY, *key) for section in SECTIONS for key in ((), ("function",))),
    ("sensors", EVERY, "kind"),
    *MODELS,
)
"""Places of references to users' own code in a scenario."""


def register_reward(name: str, function: Callable[..., Any], *, unit: str = "1", meaning: str = "") -> None:
    """Make a reward term known by name; a scenario weighs it with `reward.weights.<name>`.

    Args:
        name: an identifier.
        function: of the record `Ego`, of `Ego` and `TruthRecord`, or of these and `FleetRecord`, the fleet's mean and
            worst error and standard deviation (`coopenv.api.terms.records`); returns a number. A Warp function, or a
            plain one that Warp can compile. A term that takes more than the first is privileged.
        unit: of the value.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, or it is no function of one to three records.
    """
    _register(REWARD_TERMS, Term, name, function, (1, 2, 3), unit=unit, meaning=meaning)


def register_termination(name: str, function: Callable[..., Any], *, meaning: str = "") -> None:
    """Make a termination condition known by name; a scenario switches it on with `termination.<name> = true`.

    It is checked after every decision, and `info["outcome"]` of the vehicles whose episodes it ends is its name.

    Args:
        name: an identifier.
        function: as for `register_reward`, but returns whether the vehicle's episode ends.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, or it is no function of one or two records.
    """
    _register(TERMINATION_CONDITIONS, Term, name, function, (1, 2), meaning=meaning)


def register_observation(
    name: str,
    function: Callable[..., Any],
    *,
    per: Per = "vehicle",
    size: int = 1,
    unit: str = "1",
    scale: float | Scale = 1.0,
    low: int = -1,
    center: float = 0.0,
    meaning: str = "",
) -> None:
    """Make an observation field known by name; a scenario lists it in `observation.include`.

    Args:
        name: an identifier.
        function: of the record `Ego`, and of `Target`, `Neighbour` or `MapLandmark` if there is one value for each of
            these (`coopenv.api.terms.records`); returns a number, or a vector of `size`. A Warp function,
            or a plain one that Warp can compile. No truth is at hand in these records.
        per: "vehicle": one value; "target": one for every landmark and vehicle; "neighbour": one for every other
            vehicle; "landmark": one for each of the landmarks of the map that are nearest by the vehicle's estimate.
        size: entries of one value.
        unit: of the value.
        scale: divisor of the value: a number, or the name of a scale of `[observation]`.
        low: -1, or 0 for what is never negative: the lower end of the range.
        center: the value that reads 0.
        meaning: one line for tables; empty: the first line of the function's docstring.

    Raises:
        CoopenvError: the name is no identifier or taken, another argument has no such value, or it is no function of
            these records.
    """
    columns = {"per": per, "size": size, "unit": unit, "scale": scale, "low": low, "center": center, "meaning": meaning}
    _register(OBSERVATION_FIELDS, ObservationField, name, function, (1 if per == "vehicle" else 2,), **columns)


def _register(
    kind: Registry[R], row: type[R], name: str, function: Any, allowed: tuple[int, ...], **columns: Any
) -> None:
    where = f"{kind.kind} {shown(name)}"
    records = record_count(where, function, allowed)
    about = inspect.getdoc(getattr(function, "func", function)) or ""
    columns["meaning"] = columns["meaning"] or about.partition("\n")[0]
    if row is Term:
        columns["privileged"] = records > 1
    try:
        kind.register(name, row(function=function, **columns))
    except ValidationError as error:
        raise CoopenvError(one_line(error, where, row)) from None


def record_count(where: str, function: Any, allowed: tuple[int, ...]) -> int:
    """Return the number of records that the function of a term takes.

    Args:
        where: begins an error.
        function: a Warp function or a plain one.
        allowed: numbers of records.

    Raises:
        CoopenvError: it is no function with a name, or takes another number.
    """
    plain = getattr(function, "func", function)  # a Warp function holds the plain one
    if not inspect.isfunction(plain) or plain.__name__ == "<lambda>":
        raise CoopenvError(f"{where}: expected a function with a name (def, not lambda), got {shown(function)}")
    taken = len(inspect.signature(plain).parameters)
    if taken not in allowed:
        expected = " or ".join(map(str, allowed))
        raise CoopenvError(f"{where}: its function takes {taken} records, expected {expected}; see docs/terms.md")
    return taken


def located(
    raw: Mapping[str, Any], folder: Path, place: Callable[[str, Path], str] = installation.absolute_reference
) -> dict[str, Any]:
    """Return a scenario with its files and the references of its own terms, relative to `folder`, replaced.

    By default they become absolute.
    """
    result = dict(raw)
    for path in CODE:
        result = _changed(result, path, lambda text: place(text, folder) if installation.is_reference(text) else text)
    for path in ((section, key) for section, keys in FILES.items() for key in keys):
        result = _changed(result, path, lambda text: place(text, folder))
    return result


def _changed(part: Any, path: Sequence[str], change: Callable[[str], str]) -> Any:
    """Return plain data with the texts at a path of keys changed; data without such a place are returned as they are.

    The key `*` stands for every entry of a table or a list. In place of a text there may be a list of texts.
    """
    key, *rest = path or [EVERY]
    if not path and isinstance(part, str):
        return change(part)
    if isinstance(part, dict) and path:
        names = part if key == EVERY else {key} & part.keys()
        return {**part, **{name: _changed(part[name], rest, change) for name in names}}
    if isinstance(part, list | tuple) and key == EVERY:
        return [_changed(entry, rest, change) for entry in part]
    return part


def _is_ours(kind: Any, name: str) -> bool:
    """Return whether a name is that of a term of coopenv, as the fields of sensors are."""
    return name in kind.built_in or name.startswith(READING)


def without_own_terms(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario with terms of coopenv only, for recordings, which must name neither code nor folders."""
    result = dict(raw)
    for key, simulator in COSIMULATORS.items():
        if isinstance(raw.get(key), dict):
            result[key] = {**raw[key], **simulator.unrecorded}
    for section, kind in SECTIONS.items():
        if not isinstance(raw.get(section), dict):
            continue
        part = result[section] = {key: value for key, value in raw[section].items() if key != "custom"}
        for key in ("weights", "scales", "centers"):
            if isinstance(named := part.get(key), dict):
                part[key] = {name: value for name, value in named.items() if _is_ours(kind, name)}
        for key in ("include", "exclude"):
            if isinstance(names := part.get(key), list):
                part[key] = [name for name in names if name in GROUPS or _is_ours(kind, name)]
        if part.get("include") == []:
            part["include"] = list(USUAL_GROUPS)
        if section == "termination":
            known = (*kind.built_in, "after_arrival")
            result[section] = {key: on for key, on in part.items() if key in known}
    for path in MODELS:
        result = _changed(result, path, lambda model: DRIVES[0] if installation.is_reference(model) else model)
    return result
