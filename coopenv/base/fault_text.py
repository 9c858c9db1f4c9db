"""The spelling of a fault, the same in the benchmark of observers and for fake cars.

    FAULT = [VEHICLE[,VEHICLE...]:]NAME[=VALUE][@START[+DURATION]][,OPTION=VALUE...]

START and DURATION are in s; START may also be a share of the run, `40%`. For example `vehicle_2:lie=drift:0.05@10`.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, nan

from coopenv.base.errors import CoopenvError, check_one_of, listed, shown
from coopenv.base.sections import LARGEST

Bounds = tuple[float, float] | range  # lowest and highest number; of a range only whole ones

GRAMMAR = "[VEHICLE:]NAME[=VALUE][@START[+DURATION]][,OPTION=VALUE...]"
_FORM = re.compile(
    r"(?:(?P<vehicles>[^:=@]+):)?(?P<name>\w+)(?:=(?P<value>[^@,]+))?"
    r"(?:@(?P<start>[^+,]+)(?:\+(?P<duration>[^,]+))?)?(?P<options>(?:,[^,]+)*)"
)


class FaultError(CoopenvError):
    """A fault is not valid."""


@dataclass(frozen=True)
class FaultKind:
    """Effect of a fault, and the grammar of its text."""

    value: str
    """Placeholder of the value in capitals; empty: the fault has no value."""
    meaning: str
    default: float | None = None
    """Value of a fault without one; None: the value is required."""
    low: float = 0.0
    high: float = LARGEST
    words: Mapping[str, float] = field(default_factory=dict)
    """Words before the value, `WORD[:VALUE]`, each with its default; empty: the value is a number."""
    free_word: bool = False
    """Allow any word before the value, `[WORD:]VALUE`."""
    start: bool = False
    """Allow `@START`."""
    duration: bool = False
    options: Mapping[str, Bounds] = field(default_factory=dict)
    unused: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # options that a word does not have
    vehicles: bool = False
    """True if the fault belongs to single vehicles."""


@dataclass(frozen=True)
class Fault:
    """One fault as written in text."""

    text: str
    name: str
    value: float = 0.0
    word: str = ""
    vehicles: tuple[str, ...] = ()
    """Names; empty: the usual ones of the fault."""
    start: float | None = None
    """s, or a share of the run; None: not given."""
    is_share: bool = False
    duration: float = inf
    """s"""
    options: Mapping[str, float] = field(default_factory=dict)

    def start_in(self, length: float) -> float:
        """Return the start in a run of a length, both in s; 0 if it is not given."""
        return (self.start or 0.0) * (length if self.is_share else 1.0)


def parse_fault(text: str, kinds: Mapping[str, FaultKind]) -> Fault:
    """Read a fault.

    Raises:
        FaultError: unknown name or option, or a number that is missing or out of bounds; one line.
    """
    text = text.strip()
    found = _FORM.fullmatch(text)
    if found is None:
        raise FaultError(f"fault {shown(text)}: expected {GRAMMAR}; faults: {listed([*kinds])}")
    name = found["name"]
    check_one_of("unknown fault", name, kinds, FaultError)
    kind, where = kinds[name], f"fault {name}"
    allowed = {"vehicles": kind.vehicles, "start": kind.start, "duration": kind.duration}
    for part in (part for part, may in allowed.items() if found[part] is not None and not may):
        raise FaultError(f"{where}: has no {part}, got {shown(found[part])}")
    word, value = _value(found["value"], kind, where, name)
    bounds = {key: limits for key, limits in kind.options.items() if key not in kind.unused.get(word, ())}
    options = {}
    for option in found["options"].split(",")[1:]:
        key, equals, given = option.partition("=")
        if not equals or key in options:
            raise FaultError(f"{where}: {shown(option)} is not OPTION=VALUE, each option once")
        if key not in bounds:
            raise FaultError(f"{where}: no option {shown(key)}; allowed: {listed([*bounds]) or 'none'}")
        options[key] = _number(given, f"{where}: {key}", bounds[key])
    start = found["start"]
    is_share = start is not None and start.endswith("%")
    most = 100.0 if is_share else 1e6
    begin = None if start is None else _number(start.removesuffix("%"), f"{where}: start", (0.0, most))
    return Fault(
        text,
        name,
        value,
        word,
        tuple(found["vehicles"].split(",")) if found["vehicles"] else (),
        begin / 100.0 if begin is not None and is_share else begin,
        is_share,
        inf if found["duration"] is None else _number(found["duration"], f"{where}: duration", (0.0, 1e6)),
        options,
    )


def _value(text: str | None, kind: FaultKind, where: str, name: str) -> tuple[str, float]:
    """Return the word and the number of a value."""
    if kind.words:
        word, colon, number = (text or "").partition(":")
        check_one_of(f"{where}: unknown {name}", word, kind.words, FaultError)
        return word, _number(number, f"{where}: value", (kind.low, kind.high)) if colon else kind.words[word]
    word = ""
    if kind.free_word and text is not None:
        word, _, text = text.rpartition(":")
    if text is None:
        if kind.default is None:
            raise FaultError(f"{where}: needs a value, {name}=NUMBER ({kind.value.lower()}: {kind.meaning})")
        return word, kind.default
    if not kind.value:
        raise FaultError(f"{where}: has no value, got {shown(text)}")
    return word, _number(text, f"{where}: value", (kind.low, kind.high))


def _number(text: str, where: str, bounds: Bounds) -> float:
    try:
        number = float(text)
    except ValueError:
        number = nan
    if not (number in bounds if isinstance(bounds, range) else bounds[0] <= number <= bounds[-1]):
        kind = "whole number" if isinstance(bounds, range) else "number"
        raise FaultError(f"{where}: expected a {kind} from {bounds[0]:g} to {bounds[-1]:g}, got {shown(text)}")
    return number
