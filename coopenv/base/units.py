"""Units of the numbers in files: plausible ranges, and texts with a unit such as `"3 deg"`."""

import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import core_schema

from coopenv.base.errors import ScenarioWarning, shown
from coopenv.base.sections import Probability, rewritten

DEGREE = math.pi / 180.0
UNITS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "m": ("millimetres or centimetres in place of metres?", {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3}),
    "rad": ("degrees in place of radians?", {"rad": 1.0, "deg": DEGREE, "°": DEGREE, "mrad": 1e-3}),
    "s": ("milliseconds in place of seconds?", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}),
    "m/s": ("km/h or mm/s in place of m/s?", {"m/s": 1.0, "km/h": 1 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3}),
    "rad/s": ("deg/s in place of rad/s?", {"rad/s": 1.0, "deg/s": DEGREE, "°/s": DEGREE, "mrad/s": 1e-3}),
    "m/s^2": ("mm/s^2 in place of m/s^2?", {"m/s^2": 1.0, "m/s²": 1.0, "mm/s^2": 1e-3, "mm/s²": 1e-3}),
    "rad/s^2": ("deg/s^2 in place of rad/s^2?", {"rad/s^2": 1.0, "rad/s²": 1.0, "deg/s^2": DEGREE, "°/s²": DEGREE}),
    "Hz": ("a period in seconds in place of a rate in Hz?", {"Hz": 1.0, "1/s": 1.0, "kHz": 1e3}),
    "pixels": ("metres or millimetres in place of pixels?", {"pixels": 1.0, "px": 1.0}),
    "as a share": ("per cent in place of a share?", {"%": 0.01}),
}
"""By the unit of a key: the likely mistake in an implausible number, and sizes of the units of a text."""

_TEXT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\s\d.].*?)\s*")

TEXTS = {"type": ["number", "string"]}  # of a number that has a unit, in a JSON schema


@dataclass(frozen=True, eq=False)
class Unit:
    """Unit and plausible range of a quantity; the annotation of a number, `Annotated[Positive, LENGTH]`."""

    symbol: str  # of `UNITS`
    most: float  # plausible magnitude
    least: float = 0.0  # plausible magnitude other than 0

    def read(self, given: Any, checked: Callable[[Any], Any]) -> Any:
        """Return a number or a text with a unit, `checked`. Raises ValueError: its unit or its number is refused."""
        (likely, sizes), number = UNITS[self.symbol], given
        if given.__class__ is str and (found := _TEXT.fullmatch(given)):
            if found[2] not in sizes:
                raise ValueError(f"{given!r} has no unit of this key; allowed: {', '.join(sizes)}")
            number = float(found[1]) * sizes[found[2]]
        try:
            return checked(number)
        except ValidationError as error:
            if type(number) not in (int, float) or self._plausible(number):
                raise
            raise ValueError(f"{error.errors()[0]['msg']}, got {shown(given)}: {likely}") from None

    def doubt(self, value: float, factor: float = 1.0) -> str:
        """Return why a number is implausible, and the likely mistake, or nothing; `factor` widens the range."""
        if self._plausible(value, factor):
            return ""
        expected = f"{self.least:g} to {self.most * factor:.5g}"
        return f"{value:.6g} {self.symbol} is implausible (expected magnitude {expected}): {UNITS[self.symbol][0]}"

    def _plausible(self, value: float, factor: float = 1.0) -> bool:
        return value == 0.0 or self.least <= abs(value) <= self.most * factor

    def holds_for(self, numbers: tuple[Any, ...]) -> bool:
        """Return whether a tuple consists of plausible numbers."""
        return {*map(type, numbers)} == {float} and max(map(abs, numbers)) <= self.most and not self.least

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        reading = partial(core_schema.no_info_wrap_validator_function, self.read)
        return rewritten(handler(source), lambda node: reading(node) if node.get("type") == "float" else node)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return rewritten(handler(schema), lambda node: node | TEXTS if node.get("type") == "number" else node)


PLACE = Unit("m", 1_000.0)  # coordinates; the range grows with the scene
DISTANCE = Unit("m", 2_000.0)  # ranges of sensors and radio, ways
EXTENT = Unit("m", 500.0)  # sizes of buildings and roads, offsets of faults
LENGTH = Unit("m", 30.0)  # sizes on and about a vehicle
DETAIL = Unit("m", 2.0)  # tags and errors of sensors' positions
HEADING = Unit("rad", 3.0 * math.pi)
TURN = Unit("rad", math.pi + 1e-3)  # turns by which poses differ, steering
SMALL_ANGLE = Unit("rad", 0.2)  # errors of bearings and of cameras' mounting
TIME = Unit("s", 1_000.0)  # times in an episode; the range grows with a long episode
EPISODE = Unit("s", 7_200.0)
CLOCK = Unit("s", 604_800.0)  # time of a program's own clock: a week
LAG = Unit("s", 20.0)  # time constants, ages and delays
SPEED = Unit("m/s", 60.0)  # prescribed motions
DRIVEN_SPEED = Unit("m/s", 30.0)
SPEED_ERROR = Unit("m/s", 3.0)
TURN_RATE = Unit("rad/s", 5.0)
TURN_ACCELERATION = Unit("rad/s^2", 100.0)
TURN_RATE_ERROR = Unit("rad/s", 0.4)
ACCELERATION = Unit("m/s^2", 20.0)
FREQUENCY = Unit("Hz", 5_000.0, least=0.2)
PIXELS = Unit("pixels", 50_000.0, least=20.0)
SHARE = Unit("as a share", 0.5)  # errors of scales
CHANCE = Unit("as a share", 1.0)
Chance = Annotated[Probability, CHANCE]
Loss = Annotated[float, Field(ge=0.0, lt=1.0), CHANCE]


@cache
def units_of(model: type[BaseModel]) -> dict[str, Unit | None]:
    """Return the unit of every field of a section; None: it has none."""
    fields = model.model_fields.items()
    return {name: next((part for part in info.metadata if isinstance(part, Unit)), None) for name, info in fields}


def warn_of_implausible(model: BaseModel, factors: Mapping[Unit, float], where: str = "") -> None:
    """Warn of every key of a section with implausible numbers; of the entries of a list, the first is named.

    The ranges of some units are wider by `factors`; `where` is the section's own key.
    """
    found: dict[str, str] = {}
    for place, doubt in _doubts(model, where, None, factors):
        found.setdefault(re.sub(r"\.\d+\b", ".*", place), f"{place.removeprefix('.')}: {doubt}")
    for line in found.values():
        warnings.warn(line, ScenarioWarning, stacklevel=3)


_PLAIN = (str, bool, int, type(None))  # values without parts, which are not judged


def _doubts(node: Any, where: str, unit: Unit | None, factors: Mapping[Unit, float]) -> Iterator[tuple[str, str]]:
    """Yield place and doubt of the implausible numbers among those that are given."""
    parts: Any = ()
    kind = node.__class__  # compared without calls, because a city has thousands of values
    if kind is float:
        beyond = unit and (unit.least or not -unit.most <= node <= unit.most)
        if beyond and unit and (doubt := unit.doubt(node, factors.get(unit, 1.0))):
            yield where, doubt
    elif kind is tuple:
        parts = () if unit is not None and unit.holds_for(node) else [(i, part, unit) for i, part in enumerate(node)]
    elif isinstance(node, BaseModel):
        units, given = units_of(kind), vars(node)
        parts = [(name, given[name], units[name]) for name in node.model_fields_set if name in units]
    for name, part, own in parts:
        if part.__class__ not in _PLAIN:
            yield from _doubts(part, f"{where}.{name}", own, factors)
