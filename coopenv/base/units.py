"""Units of the numbers in files: plausible ranges, and texts with a unit such as `"3 deg"`."""

import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import core_schema

from coopenv.base.errors import ScenarioWarning, shown

SCALES: Mapping[str, Mapping[str, float]] = {
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3},
    "rad": {"rad": 1.0, "deg": math.pi / 180, "mrad": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "pixels": {"pixels": 1.0, "px": 1.0},
    "1": {"%": 0.01},
}
"""Sizes of the units of a text, by the unit of the key. Quotients such as km/h follow from them."""
NAMES = {"m": "metres", "rad": "radians", "s": "seconds", "1": "a share", "Hz": "a frequency in Hz"}

_TEXT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\W\d_%].*?|[%°].*?)\s*")


@dataclass(frozen=True, eq=False)  # two quantities may have the same range
class Unit:
    """Unit and plausible range of a quantity; the annotation of a number, `Annotated[Positive, LENGTH]`."""

    symbol: str
    """Unit of the key."""
    most: float
    """Largest plausible magnitude."""
    mistake: str
    """Likely unit of a number beyond it."""
    least: float = 0.0
    """Smallest plausible magnitude other than 0."""

    def read(self, given: Any, checked: Callable[[Any], Any]) -> Any:
        """Return a number in the key's unit, `checked`; a text with a unit is converted before.

        Raises:
            ValueError: the text has another kind of unit, or an implausible number is also out of bounds.
        """
        number = self.converted(given)
        try:
            return checked(number)
        except ValidationError as error:
            if not isinstance(number, int | float) or not self.doubt(number):
                raise
            raise ValueError(f"{error.errors()[0]['msg']}, got {shown(given)}: {self.likely}") from None

    def converted(self, given: Any) -> Any:
        """Return a text with a unit as a number in the key's unit, anything else unchanged.

        Raises:
            ValueError: the text has another kind of unit.
        """
        found = _TEXT.fullmatch(given) if isinstance(given, str) else None
        if found is None:
            return given
        parts = [SCALES[part] for part in self.symbol.split("/")]
        units = found[2].replace("°", "deg").replace("^2", "²").replace("s²", "s/s").split("/")
        if len(units) != len(parts) or any(unit not in known for unit, known in zip(units, parts, strict=True)):
            known = " / ".join(", ".join(part) for part in parts)
            raise ValueError(f"{given!r} has no unit of this key; allowed: {known}")
        size, *divisors = (known[unit] for unit, known in zip(units, parts, strict=True))
        return float(found[1]) * size / math.prod(divisors)

    def doubt(self, value: float, factor: float = 1.0) -> str:
        """Return why a number is implausible and its likely unit, or nothing; `factor` widens the range."""
        unit = "" if self.symbol == "1" else f" {self.symbol}"
        if abs(value) > self.most * factor:
            limit = f"above {self.most * factor:.4g}"
        elif 0.0 < abs(value) < self.least:
            limit = f"below {self.least:.4g}"
        else:
            return ""
        return f"{value:.6g}{unit} is implausible ({limit}{unit}): {self.likely}"

    @property
    def likely(self) -> str:
        """The likely mistake, as a question."""
        return f"{self.mistake} in place of {NAMES.get(self.symbol, self.symbol)}?"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        def reading(node: Any) -> Any:
            if isinstance(node, dict) and node.get("type") == "float":
                return core_schema.no_info_wrap_validator_function(self.read, node)
            if isinstance(node, dict):
                return {key: reading(value) for key, value in node.items()}
            return [reading(value) for value in node] if isinstance(node, list) else node

        return reading(handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        """Return the JSON schema with the unit; a text with a unit may stand for a number."""
        texts = {"type": ["number", "string"], "pattern": r"^\s*[+-]?[\d.]+\s*\D"}

        def reading(node: Any) -> Any:
            if isinstance(node, dict):
                texts_too = texts if node.get("type") == "number" else {}
                return {key: reading(value) for key, value in node.items()} | texts_too
            return [reading(value) for value in node] if isinstance(node, list) else node

        return reading(handler(schema)) | {"unit": self.symbol}


PLACE = Unit("m", 1_000.0, "millimetres")
"""Coordinates in the scene; the range grows with its roads and vehicles."""
DISTANCE = Unit("m", 2_000.0, "millimetres")
"""Ranges of sensors and radio, ways."""
EXTENT = Unit("m", 500.0, "millimetres")
"""Sizes of buildings and roads, offsets of faults."""
LENGTH = Unit("m", 30.0, "millimetres or centimetres")
"""Sizes on and about a vehicle."""
DETAIL = Unit("m", 2.0, "millimetres or centimetres")
"""Tags and errors of sensors' positions."""
HEADING = Unit("rad", 3 * math.pi, "degrees")
TURN = Unit("rad", math.pi + 1e-3, "degrees")
"""Turns by which poses differ."""
STEERING = Unit("rad", math.pi / 2, "degrees")
SMALL_ANGLE = Unit("rad", 0.2, "degrees")
"""Errors of bearings and of cameras' mounting."""
TIME = Unit("s", 1_000.0, "milliseconds")
"""Times in an episode; the range grows with a long episode."""
EPISODE = Unit("s", 3_600.0, "milliseconds")
CLOCK = Unit("s", 604_800.0, "milliseconds")
"""Time of a program's own clock."""
LAG = Unit("s", 20.0, "milliseconds")
"""Time constants, ages and delays."""
SPEED = Unit("m/s", 60.0, "km/h or mm/s")
"""Speeds of prescribed motions, and scales of observations."""
DRIVEN_SPEED = Unit("m/s", 30.0, "km/h or mm/s")
SPEED_ERROR = Unit("m/s", 3.0, "km/h or mm/s")
TURN_RATE = Unit("rad/s", 5.0, "deg/s")
TURN_RATE_ERROR = Unit("rad/s", 0.4, "deg/s")
ACCELERATION = Unit("m/s/s", 20.0, "km/h/s or mm/s/s")
FREQUENCY = Unit("Hz", 5_000.0, "a period", least=0.2)
FOCAL_LENGTH = Unit("pixels", 50_000.0, "metres or millimetres", least=20.0)
PIXELS = Unit("pixels", 50_000.0, "metres or millimetres", least=1.0)
SHARE = Unit("1", 0.5, "per cent")


@cache
def units_of(model: type[BaseModel]) -> dict[str, Unit]:
    """Return the unit of every field of a section that has one."""
    found = ((name, _units(info.annotation, *info.metadata)) for name, info in model.model_fields.items())
    return {name: units[0] for name, units in found if units}


def _units(*annotations: Any) -> list[Unit]:
    own = [part for part in annotations if isinstance(part, Unit)]
    return own or [unit for part in annotations for unit in _units(*get_args(part))]


def warn_of_implausible(model: BaseModel, factors: Mapping[Unit, float], where: str = "") -> None:
    """Warn of every key of a section with implausible numbers; entries of lists share one line.

    Args:
        model: the section.
        factors: by which the ranges of some units are wider.
        where: the section's own key.
    """
    seen: dict[str, list[str]] = {}
    for place, key, unit, value in _numbers(model, where, where, None):
        if doubt := unit.doubt(value, factors.get(unit, 1.0)):
            seen.setdefault(key, []).append(f"{place}: {doubt}")
    for first, *more in seen.values():
        warnings.warn(f"{first} (likewise {len(more)} more)" if more else first, ScenarioWarning, stacklevel=3)


def _numbers(node: Any, where: str, key: str, unit: Unit | None) -> Iterator[tuple[str, str, Unit, float]]:
    """Yield place, key (`*` for the entry of a list), unit and value of the numbers that are given."""
    if isinstance(node, float):
        if unit is not None:
            yield where, key, unit, node
        return
    if isinstance(node, BaseModel):
        given, units = vars(node), units_of(type(node))
        parts = [(name, name, given[name], units.get(name)) for name in node.model_fields_set if name in given]
    elif isinstance(node, dict):
        parts = [(name, name, entry, unit) for name, entry in node.items()]
    else:
        parts = [(str(i), "*", entry, unit) for i, entry in enumerate(node)]
    dot = "." if where else ""
    for name, kind, entry, own in parts:
        if isinstance(entry, BaseModel | tuple | dict) or (own is not None and isinstance(entry, float)):
            yield from _numbers(entry, f"{where}{dot}{name}", f"{key}{dot}{kind}", own)
