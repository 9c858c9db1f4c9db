"""What comes of judging: of a record, and of one observer on it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array

STEADY = "steady"


class Window(NamedTuple):
    """A stretch of a run, its start left out and its end included, s."""

    start: float
    end: float
    steady: bool = False

    @property
    def name(self) -> str:
        """What tables call it."""
        return STEADY if self.steady else f"{self.start:g}-{self.end:g} s"

    def ticks(self, t: Array) -> NDArray[np.bool_]:
        """Return which of the times (K,) s lie within."""
        return np.asarray((t > self.start) & (t <= self.end))


def windows_of(edges: Iterable[float], steady_from: float, end: float) -> tuple[Window, ...]:
    """Return the windows between edges, s, as far as a run goes, and the steady state."""
    between = [Window(start, min(stop, end)) for start, stop in pairwise(edges) if start < end]
    return (*between, Window(steady_from, end, steady=True))


@dataclass(frozen=True)
class Scene:
    """What belongs to the record and not to an observer; arrays (N,), NaN where unknown."""

    vehicles: tuple[str, ...]
    bound_mse: Array  # m^2 in the steady state: joint over all vehicles,
    bound_ancestors_mse: Array  # joint over a vehicle and its ancestors,
    bound_single_mse: Array  # and alone with known neighbours
    gramian: Array  # smallest eigenvalue over the run, as in the theorem: about the map origin, mixed units
    gramian_local: Array  # the same about the vehicle, without unit
    steady_from: float  # s
    t: Array  # (S,) s
    bound: Array  # (S, N) m, joint
    paper_noise: bool  # bearings are noisy on the image plane, and so less than the bound assumes off the optical axis
    windows: tuple[Window, ...]  # W stretches that are judged one by one, the steady state last
    window_bound_mse: Array  # (N, W) m^2, joint over a vehicle and its ancestors


class Series(NamedTuple):
    """What figures show, at `Scene.t`; arrays (S, N)."""

    position_error: Array  # m
    position_std: Array  # m, NaN where the observer states no covariance
    nees: Array


@dataclass(frozen=True)
class Sample:
    """One observer on one record."""

    variant: str
    observer: str
    scene: Scene
    measures: Mapping[str, Array]
    """Arrays (N,) by name, (N, W) in windows, see `judge`; none where it failed."""
    bytes_per_s: Array
    us_per_update: Array
    nees_dof: int
    failure: str
    series: Series

    def measured(self, name: str, vehicles: int | slice = slice(None)) -> Any:
        """Return what was measured of some vehicles; NaN where the observer failed, which has diverged."""
        nothing = np.full(len(self.scene.vehicles), 1.0 if name == "diverged" else np.nan)
        return self.measures.get(name, nothing)[vehicles]

    def in_windows(self, name: str) -> Array:
        """Return (N, W) what was measured in each window of the scene; NaN where the observer failed."""
        return self.measures.get(name, np.full((len(self.scene.vehicles), len(self.scene.windows)), np.nan))
