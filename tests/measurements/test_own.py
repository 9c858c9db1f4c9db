"""A user's class as a kind of measurement: what it may leave out, and errors that name file, class and attribute."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from textwrap import indent

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from coopenv import CoopenvError
from coopenv.measurements.kinds import Kind, Landmarks, Placed
from coopenv.measurements.own import OwnKind, placed_at_random
from coopenv.measurements.sensor import kept_kind, kind_of
from tests.helpers.sessions import ROOT

EXAMPLES = ROOT / "examples" / "own_sensors.py"
RANGE = "def predict(self, own, target): return np.linalg.norm(target.position - own.position)"


def written(folder: Path, *body: str) -> str:
    """Return the reference of a class with a body."""
    file = folder / "mine.py"
    lines = indent("\n".join(body), "    ")
    file.write_text(f"import numpy as np\n\n\nclass Mine:\n{lines}\n", encoding="utf-8")
    return f"{file}:Mine"


def places(count: int) -> tuple[Placed, Placed]:
    """Return a batch of sensors and one of targets, 3 m apart at least."""
    rng = np.random.default_rng(2)
    own, target = ([placed_at_random(rng) for _ in range(count)] for _ in range(2))
    batches = []
    for of, shift in ((own, 0.0), (target, 25.0)):
        arrays = (np.stack([getattr(one, name) for one in of]) for name in vars(of[0]) if name != "landmarks")
        batches.append(Placed(*arrays))
        batches[-1] = replace(batches[-1], position=batches[-1].position + shift)
    return batches[0], batches[1]


def test_a_class_with_a_prediction_and_noise_does_as_the_shipped_kind(tmp_path: Path) -> None:
    mine, shipped = kind_of(written(tmp_path, "noise = 0.1", RANGE)), kind_of("range")
    own, target = places(5)
    value = shipped.predict(own, target)
    assert (mine.rows, mine.size, mine.noise, mine.needs) == (1, 1, (0.1,), ())
    assert_allclose(mine.predict(own, target), value)
    assert_allclose(mine.residual(value + 0.2, value), np.full((5, 1), 0.2))
    assert_allclose(mine.sample(value, np.full((5, 1), 0.3)), value + 0.3)
    for found, expected in zip(mine.jacobian(own, target), shipped.jacobian(own, target), strict=True):
        assert_allclose(found, expected, atol=1e-9)
    assert mine.sensed(own, target).all()


def test_a_class_with_every_function_is_used_with_each_of_them(tmp_path: Path) -> None:
    """A compass in degrees: its value has a jump, its rows have none."""
    mine = kind_of(
        written(
            tmp_path,
            'has_target, noise, units = False, 2.0, ("deg",)',
            "def predict(self, own, target):",
            "    return np.degrees(np.arctan2(own.rotation[1, 0], own.rotation[0, 0]))",
            "def residual(self, value, predicted): return (value - predicted + 180.0) % 360.0 - 180.0",
            "def sample(self, predicted, noise): return (predicted + noise + 180.0) % 360.0 - 180.0",
            "def sensed(self, own, target): return own.position[2] > 0.0",
            "def jacobian(self, own, target):",
            "    (a, b), c = own.rotation[:2, 0], own.rotation",
            "    turn = a * np.array([0, -c[1, 2], c[1, 1]]) - b * np.array([0, -c[0, 2], c[0, 1]])",
            "    return np.hstack([np.degrees(turn / (a * a + b * b)), np.zeros(3)])",
        )
    )
    assert (mine.towards, mine.has_target, mine.units) == (("map",), False, ("deg",))
    assert_allclose(mine.residual(np.array([-179.0]), np.array([179.0])), [2.0])
    assert_allclose(mine.sample(np.array([[179.0]]), np.array([[3.0]])), [[-178.0]])
    own, target = places(6)
    assert_array_equal(mine.sensed(own, target), own.position[:, 2] > 0.0)
    assert_allclose(mine.jacobian(own, target)[0], Kind.differences(mine, own, target)[0], atol=1e-6)


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ([RANGE], "noise: expected one positive number, or 1 of them, got None"),
        (["noise = 'much'", RANGE], "noise: expected one positive number, or 1 of them, got 'much'"),
        (["noise = 0.0", RANGE], "noise: expected one positive number, or 1 of them, got 0.0"),
        (["noise = 0.1, 0.1", RANGE], "noise: expected one positive number, or 1 of them, got (0.1, 0.1)"),
        (["noise = 0.1"], "expected a class with predict(own, target), got <class"),
        (["noise = 0.1", "def predict(self, own): return 1.0"], "predict: TypeError: "),
        (
            ["noise = 0.1", "def predict(self, own, target): return 'far'"],
            "predict: expected 1 to 6 numbers, got 'far'",
        ),
        (
            ["noise = 0.1", "def predict(self, own, target): return own"],
            "predict: expected 1 to 6 numbers, got Placed(",
        ),
        (["noise = 0.1", "def predict(self, own, target): return []"], "predict: expected 1 to 6 numbers, got []"),
        (["noise = 0.1", "def predict(self, own, target): return np.eye(2)"], "predict: expected 1 to 6 numbers, got"),
        (["noise = 0.1", "def predict(self, own, target): return np.ones(7)"], "predict: expected 1 to 6 numbers, got"),
        (["noise = 0.1", "def predict(self, own, target): return np.nan"], "predict: not finite: nan"),
        (["noise = 0.1", "def predict(self, own, target): return own.speed"], "predict: AttributeError: "),
        (
            ["noise = 0.1", RANGE, "def residual(self, a, b): return None"],
            "residual: not finite: None",
        ),
        (["noise = 0.1", RANGE, "def residual(self, a, b): raise OSError('no')"], "residual: OSError: no"),
        (
            ["noise = 0.1", RANGE, "def sample(self, a, b): return 1.0, 2.0"],
            "sample: expected shape (1,), got (1.0, 2.0)",
        ),
        (["noise = 0.1", RANGE, "def sample(self, a, b): return np.nan"], "sample: not finite: array([nan])"),
        (["noise = 0.1", "def predict(self, own, target): return 1j"], "predict: expected 1 to 6 numbers, got 1j"),
        (["noise = 0.1", "def predict(self, own, target): raise SystemExit(3)"], "predict: SystemExit: 3"),
        (["noise = 0.1", RANGE, "def sensed(self, own): return True"], "sensed: TypeError: "),
        (
            ["noise = 0.1", RANGE, "def sensed(self, own, target): return target.position > 0"],
            "sensed: expected shape (1,), got array(",
        ),
        (["noise = 0.1", RANGE, "units = 'm', 'm'"], "units: 2 for 1 rows"),
        (["noise = 0.1", RANGE, "units = 1"], "units: expected texts, got 1"),
        (["noise = 0.1", RANGE, "towards = ('map', 3)"], "towards: expected texts, got ('map', 3)"),
        (["noise = 0.1", RANGE, "def __init__(self, reach): pass"], "its start: TypeError: "),
        (["noise = 0.1", RANGE, "def residual(self, a, b): return np.ones(2)"], "sample: missing; predict returns 1 "),
        (
            ["noise = 0.1", RANGE, "def jacobian(self, own, target): return np.zeros(6), np.ones(6)"],
            "jacobian by the sensor: entry [0, ",
        ),
        (
            ["noise = 0.1", RANGE, "def jacobian(self, own, target): return np.zeros((2, 6)), np.zeros((2, 6))"],
            "jacobian: expected shape (1, 6), got array(",
        ),
    ],
)
def test_a_wrong_class_is_named_in_one_line(tmp_path: Path, body: list[str], problem: str) -> None:
    reference = written(tmp_path, *body)
    with pytest.raises(CoopenvError) as caught:
        OwnKind(reference, {})
    text = str(caught.value)
    assert text.startswith(f"sensor '{reference}': {problem}")
    assert "\n" not in text and len(text) < 300 + len(reference)


@pytest.mark.parametrize(
    ("reference", "problem"),
    [
        ("none.py:Mine", "'none.py:Mine': no such file: "),
        (f"{EXAMPLES}:Dopler", "no 'Dopler' in .*own_sensors.py \\(did you mean 'Doppler'\\?\\)"),
        (f"{EXAMPLES}:away", "expected a class with predict\\(own, target\\), got <function away"),
        (f"{EXAMPLES}:RangeDifference", "its start: TypeError: .*reference"),
        ("ranges", "unknown kind of sensor 'ranges' \\(did you mean 'range'\\?\\)"),
    ],
)
def test_a_class_that_is_not_there_is_named(reference: str, problem: str) -> None:
    with pytest.raises(CoopenvError, match=problem) as caught:
        kind_of(reference)
    assert "\n" not in str(caught.value)


def test_a_file_that_does_not_compile_is_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("class Mine:\n    noise = = 1\n", encoding="utf-8")
    with pytest.raises(CoopenvError, match=re.escape(f"'{file}:Mine' cannot be loaded: SyntaxError: ")):
        kind_of(f"{file}:Mine")


def test_the_derivative_of_a_range_difference_needs_the_reference_of_each_entry() -> None:
    """A batch may have a landmark that moves; each entry has the position at its own time."""
    kind = kind_of(f"{EXAMPLES}:RangeDifference", '{"reference": "mast"}')
    own, target = places(4)
    path = np.linspace([1.0, 2.0, 3.0], [4.0, 5.0, 9.0], 4)
    values = kind.predict(replace(own, landmarks=Landmarks(mast=path)), target)
    expected = [
        np.linalg.norm(z - p) - np.linalg.norm(mast - p)
        for z, p, mast in zip(target.position, own.position, path, strict=True)
    ]
    assert_allclose(values[:, 0], expected)
    with pytest.raises(CoopenvError, match=r"own\.landmarks: unknown landmark 'mast'; known: roof"):
        kind.predict(replace(own, landmarks=Landmarks(roof=np.zeros(3))), target)


def test_a_class_is_loaded_again_after_its_file_has_changed(tmp_path: Path) -> None:
    reference = written(tmp_path, "noise = 0.1", RANGE)
    assert kept_kind(reference, "{}") is kept_kind(reference, "{}")
    written(tmp_path, "noise = 0.25", RANGE)
    os.utime(tmp_path / "mine.py", ns=(1, 1))
    assert kept_kind(reference, "{}").noise == (0.25,)


def test_a_class_is_tried_only_where_it_measures(tmp_path: Path) -> None:
    kind = kind_of(
        written(
            tmp_path,
            "noise = 0.1",
            "def predict(self, own, target):",
            "    if own.position[0] < 0: raise IndexError('outside the chart')",
            "    return min(np.linalg.norm(own.position - at) for at in own.landmarks.values())",
            "def sensed(self, own, target): return own.position[0] > 0",
        )
    )
    assert kind.rows == 1


def test_numbers_of_different_units_are_parts_of_their_own(tmp_path: Path) -> None:
    body = "noise, units = 0.1, ('rad', 'm/s')", "def predict(self, own, target): return own.position[:2]"
    assert kind_of(written(tmp_path, *body)).parts == (("1", 1, "rad"), ("2", 1, "m/s"))
