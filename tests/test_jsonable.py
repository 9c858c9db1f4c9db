"""Results as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.format import json_text, jsonable


@dataclass
class Row:
    name: str
    value: float


VALUE: dict[str, Any] = {
    "a": np.float64("nan"),
    "b": [math.inf, np.int64(3), np.array([1.0, np.nan])],
    "c": (True, "x", None, np.bool_(False)),
    "d": Row("y", -math.inf),
    "e": Path("out/run"),
    "f": np.float32(0.5),
}
PLAIN = {
    "a": None,
    "b": [None, 3, [1.0, None]],
    "c": [True, "x", None, False],
    "d": {"name": "y", "value": None},
    "e": "out/run",
    "f": 0.5,
}


def test_numpy_and_nan_are_written_as_json_knows_them() -> None:
    assert json.loads(json_text(VALUE)) == PLAIN
    assert json_text(VALUE).endswith("}\n")


def test_plain_python_survives_a_strict_encoder() -> None:
    assert json.loads(json.dumps(jsonable(VALUE), allow_nan=False)) == PLAIN
