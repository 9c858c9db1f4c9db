"""Texts with a unit, and plausible ranges of quantities."""

import math
import re
from typing import Annotated, Any

import pytest
from pydantic import Field

from coopenv.base.errors import CoopenvError, ScenarioWarning
from coopenv.base.sections import Positive, Section, Vector2, validated
from coopenv.base.units import (
    ACCELERATION,
    DETAIL,
    HEADING,
    PIXELS,
    PLACE,
    SHARE,
    SPEED,
    TIME,
    TURN_RATE,
    UNITS,
    Unit,
    warn_of_implausible,
)


class Parts(Section):
    """A section with units."""

    side: Annotated[Positive | None, DETAIL] = None
    places: Annotated[tuple[Vector2, ...], PLACE] = ()
    named: Annotated[dict[str, Positive], TIME] = Field(default={})
    times: Annotated[tuple[Positive, ...], TIME] = ()
    plain: float = 0.0


@pytest.mark.parametrize(
    ("unit", "text", "value"),
    [
        (DETAIL, "60 mm", 0.06),
        (DETAIL, " +6.cm ", 0.06),
        (HEADING, "-3 deg", -math.radians(3.0)),
        (HEADING, "45°", math.pi / 4),
        (TIME, "2.5e2ms", 0.25),
        (TIME, "1 min", 60.0),
        (SPEED, "36 km/h", 10.0),
        (TURN_RATE, "180 deg/s", math.pi),
        (ACCELERATION, "3 m/s^2", 3.0),
        (ACCELERATION, "3 mm/s²", 0.003),
        (SHARE, "3 %", 0.03),
    ],
)
def test_a_text_with_a_unit_is_converted_to_the_unit_of_the_key(unit: Unit, text: str, value: float) -> None:
    read: Any = unit.read(text, float)
    assert read == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("text", ["three deg", "", "nan deg", "3 deg 4"])
def test_other_texts_are_no_numbers(text: str) -> None:
    with pytest.raises(CoopenvError, match=r"parts: side: (Input should be a valid number|'3 deg 4' has no unit)"):
        validated(Parts, {"side": text}, "parts")


@pytest.mark.parametrize("text", ["3 deg", "3 m/s", "3 kg"])
def test_a_unit_of_another_quantity_is_refused_with_the_allowed_units(text: str) -> None:
    with pytest.raises(CoopenvError, match=rf"^parts: side: '{text}' has no unit of this key; allowed: m, mm, cm, km$"):
        validated(Parts, {"side": text}, "parts")


def test_bounds_hold_for_the_converted_number() -> None:
    with pytest.raises(CoopenvError, match=r"side: Input should be greater than 0, got -0.06"):
        validated(Parts, {"side": "-60 mm"}, "parts")
    assert validated(Parts, '{"places": [["1 km", 2]], "named": {"x": "20 ms"}}', "parts").places == ((1000.0, 2.0),)


@pytest.mark.parametrize("given", [10**400, -(10**400), "1e400 m"])
def test_a_number_beyond_the_largest_float_is_refused_in_one_line(given: object) -> None:
    likely = re.escape(UNITS["m"][0])
    with pytest.raises(CoopenvError, match=rf"^parts: side: Input should be a .* number, got .*: {likely}$"):
        validated(Parts, {"side": given}, "parts")


def test_every_implausible_key_is_named_once_with_value_unit_and_likely_mistake() -> None:
    parts = validated(Parts, {"side": 60, "places": [[6000, 1], [1, 9000]], "times": [1e6], "plain": 1e8}, "parts")
    with pytest.warns(ScenarioWarning) as caught:
        warn_of_implausible(parts, {TIME: 2.0}, "parts")
    lengths, times = UNITS["m"][0], UNITS["s"][0]
    assert sorted(str(line.message) for line in caught) == [
        f"parts.places.0.0: 6000 m is implausible (expected magnitude 0 to 1000): {lengths}",
        f"parts.side: 60 m is implausible (expected magnitude 0 to 2): {lengths}",
        f"parts.times.0: 1e+06 s is implausible (expected magnitude 0 to 2000): {times}",
    ]


def test_the_entries_of_a_list_are_named_once() -> None:
    parts = validated(Parts, {"places": [[x, 1.0] for x in range(5000, 9000)]}, "parts")
    with pytest.warns(ScenarioWarning) as caught:
        warn_of_implausible(parts, {})
    assert [str(line.message).split(" m ")[0] for line in caught] == ["places.0.0: 5000"]


def test_numbers_below_the_range_are_implausible_and_zero_is_not() -> None:
    assert PIXELS.doubt(0.004).startswith(
        "0.004 pixels is implausible (expected magnitude 20 to 50000): metres or millimetres"
    )
    assert PIXELS.doubt(0.0) == PIXELS.doubt(213.0) == ""


def test_the_schema_allows_texts_where_there_is_a_unit() -> None:
    schema = Parts.model_json_schema()["properties"]
    assert schema["side"]["anyOf"][0]["type"] == ["number", "string"]
    assert schema["plain"]["type"] == "number"
