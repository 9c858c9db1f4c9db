"""Recordings to write, read and replay, and their comparison bit for bit."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np

from coopenv.observers import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario


@cache
def simulated(name: str = "busy_intersection", seed: int = 0, **overrides: Any) -> Recording:
    """Return a second of an environment, dots in keys as two underscores."""
    return record(
        load_scenario(name, {"horizon": 1.0, **{k.replace("__", "."): v for k, v in overrides.items()}}), seed
    )


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Return where two records differ in value, type, shape or dtype; NaN equals NaN."""
    if isinstance(a, np.ndarray):
        same = isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return [] if same else [where]
    if is_dataclass(a) and type(a) is type(b):
        return [d for f in fields(a) for d in differences(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")]
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}.{i}")]
    return [] if type(a) is type(b) and a == b else [where]
