"""Recordings to write, read and replay, and their comparison bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from coopenv.observers import Message, Recording, Run, run
from coopenv.observers.contract import Factory
from coopenv.observers.group import Tamper
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.worlds import Replay
from coopenv.world.world import World


@cache
def simulated(name: str = "busy_intersection", seed: int = 0, **overrides: Any) -> Recording:
    """Return a second of an environment, dots in keys as two underscores."""
    return record(
        load_scenario(name, {"horizon": 1.0, **{k.replace("__", "."): v for k, v in overrides.items()}}), seed
    )


def completed(observer: str | Factory, recording: Recording, tamper: Tamper | None = None) -> Run:
    """Return a run that has not failed."""
    result = run(observer, recording, tamper)
    assert not result.failure
    return result


class Tampering:
    """Changes what a vehicle broadcasts, by functions of its messages in turn."""

    def __init__(self, *changes: Callable[[Message], Any], vehicle: int = 1) -> None:
        self.turn, self.vehicle = cycle(changes), vehicle

    def __call__(self, vehicle: int, time: float, observer: Any, message: Message) -> Any:
        return next(self.turn)(message) if vehicle == self.vehicle else message


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Return where two records differ in value, type, shape or dtype; NaN equals NaN."""
    if isinstance(a, np.ndarray):
        same = isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return [] if same else [where]
    if is_dataclass(a) and type(a) is type(b):
        return [d for f in fields(a) for d in differences(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")]
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}.{i}")]
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [d for name in a for d in differences(a[name], b[name], f"{where}.{name}")]
    return [] if type(a) is type(b) and a == b else [where]


class Played(NamedTuple):
    """K ticks of N vehicles."""

    rotation: np.ndarray  # (K, N, 3, 3)
    position: np.ndarray  # (K, N, 3) map, m
    covariance: np.ndarray  # (K, N, 6, 6) over (2 lambda, p)
    searching: np.ndarray  # (K, N) bool
    world: World


def replayed(recording: Recording, dtype: str = "float64", observer: str = "robust") -> Played:
    """Replay a record."""
    world = Replay(recording, "record", {"observer.name": observer}).world(1, dtype, "cpu", 1)
    world.reset([0])
    rows = []
    for tick in range(recording.ticks):
        if tick > 0:
            world.advance(1)
        R = world.view("estimate_rotation")[0].astype(float)
        p = (R @ world.view("estimate_position")[0].astype(float)[..., None])[..., 0]
        P = world.view("covariance")[0].astype(float)
        rows.append((R, p, P, world.state_arrays()["observer_search.active"].numpy()[0] == 1))
    return Played(*(np.array(column) for column in zip(*rows, strict=True)), world=world)
