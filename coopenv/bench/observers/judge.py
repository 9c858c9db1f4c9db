"""One record, judged: the errors of every observer against the truth and the bounds."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.bench.observers.sources import Source
from coopenv.estimation.metrics import (
    CONVERGED,
    SETTLED,
    SettlingTolerance,
    absolute_error,
    diverged,
    fit_exponential_rate,
    position_std,
    relative_error,
    settling_time,
)
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.poses import Array
from coopenv.observers.bound import Bound, cramer_rao, cramer_rao_ancestors
from coopenv.observers.contract import Factory
from coopenv.observers.recording import Recording
from coopenv.observers.runner import Run, run

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
    """Properties of the record, the same for all observers; arrays (N,), NaN where unknown."""

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


SERIES_TICKS = 250  # instants that are kept for figures
MOST_KEPT = 2  # bounds of records; those of many vehicles take minutes, and often every seed has the same

_kept: OrderedDict[bytes, list[Bound]] = OrderedDict()


def scene_of(recording: Recording, steady_from: float, edges: Sequence[float] = ()) -> Scene:
    """Return the bounds and the observability of a record, `edges` being those of the windows to judge it in, s.

    The noise of recorded robots is not known, and so neither is their bound.
    """
    N = len(recording.setups)
    kept, unknown = kept_ticks(recording), np.full(N, np.nan)
    windows = windows_of(edges, steady_from, float(recording.t[-1]))
    known = bool(recording.truth.known.all())
    bounds: list[Bound] = []
    if known and not any(setup.planar for setup in recording.setups):
        bounds = _bounds(recording)
    steady = recording.t > steady_from
    mse = [np.mean(bound.position[steady] ** 2, axis=0) for bound in bounds] or [unknown] * 3
    within = np.full((N, len(windows)), np.nan)
    if bounds:
        within = np.array([_mean(bounds[1].position[w.ticks(recording.t)] ** 2) for w in windows]).T
    gramians = [unknown, unknown]
    if known:
        seen = analyse_observability(_Geometry(recording))
        gramians = [values.min(axis=0, initial=np.inf) for values in (seen.min_eigenvalue, seen.local_eigenvalue)]
    names = tuple(setup.name for setup in recording.setups)
    bound = bounds[0].position[kept] if bounds else np.full((len(kept), N), np.nan)
    paper_noise = any(setup.noise.image_axis is not None for setup in recording.setups)
    (joint, ancestors, single), (about_map, about_vehicle), t = mse, gramians, recording.t[kept]
    judged = (steady_from, t, bound, paper_noise, windows, within)
    return Scene(names, joint, ancestors, single, about_map, about_vehicle, *judged)


class _Geometry:
    """A record as `analyse_observability` reads it."""

    def __init__(self, recording: Recording) -> None:
        self.t, self.visible, truth = recording.t, recording.visible, recording.truth
        self.position, self.rotation = truth.position, truth.rotation
        marker = np.array([setup.marker for setup in recording.setups])
        seen = truth.position + (truth.rotation @ marker[..., None])[..., 0]  # the points of vehicles that cameras see
        self.target_position = np.concatenate([recording.landmarks, seen], axis=1)
        self.vehicles = np.array([setup.name for setup in recording.setups])


def kept_ticks(recording: Recording) -> np.ndarray:
    """Return the ticks of which figures show something."""
    return np.unique(np.linspace(0, recording.ticks - 1, SERIES_TICKS).round().astype(int))


def _mean(values: Array) -> Array:
    """Return the mean over the first axis, NaN when it is empty."""
    return np.mean(values, axis=0) if len(values) else np.full(values.shape[1:], np.nan)


def _bounds(recording: Recording) -> list[Bound]:
    """Return the bounds joint over all, over ancestors, and alone; of a record that differs in noise alone at once."""
    key = _fingerprint(recording)
    if key in _kept:
        _kept.move_to_end(key)
        return _kept[key]
    _kept[key] = [cramer_rao(recording), cramer_rao_ancestors(recording), cramer_rao(recording, joint=False)]
    while len(_kept) > MOST_KEPT:
        _kept.popitem(last=False)
    return _kept[key]


def _fingerprint(recording: Recording) -> bytes:
    """Return a digest of everything that bounds depend on: truth, visibility, noise, and what is known at the start."""
    r, digest = recording, sha256()
    for setup in r.setups:
        digest.update(repr((setup.noise, setup.landmarks)).encode())
        for part in (setup.targets, setup.marker, setup.lever_arm):
            digest.update(np.ascontiguousarray(part).tobytes())
    for array in (r.truth.rotation, r.truth.position, r.visible, r.landmarks, r.due, r.start_covariance):
        digest.update(repr((array.shape, r.dt)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


RELATIVE_DELTA = 1.0  # s between the poses of a pair of the relative trajectory error


@dataclass(frozen=True)
class Task:
    """One record and its observers; small, so that it travels to a worker."""

    source: Source
    variant: str
    seed: int
    observers: Mapping[str, str | Factory]
    """By name, as `registry.find` takes them in another process."""
    steady_from: float | None
    edges: tuple[float, ...] = ()
    """s, of the windows that are judged one by one."""


def judge(task: Task) -> list[Sample]:
    """Make the record and run every observer of a task on it."""
    recording = task.source.recording(task.variant, task.seed)
    steady_from = task.source.steady_from(task.steady_from, recording)
    scene = scene_of(recording, steady_from, task.edges)
    return [
        sample_of(task.variant, name, scene, recording, run(factory, recording))
        for name, factory in task.observers.items()
    ]


def sample_of(variant: str, observer: str, scene: Scene, recording: Recording, result: Run) -> Sample:
    """Judge one run. Where it failed, everything but its costs is NaN."""
    if result.failure:
        measures, series = {}, Series(*np.full((3, len(scene.t), len(scene.vehicles)), np.nan))
    else:
        measures, series = _measures(scene, recording, result), _series(recording, result)
    costs = result.bytes_per_second, result.microseconds_per_update
    return Sample(variant, observer, scene, measures, *costs, result.nees_dof, result.failure, series)


def _measures(scene: Scene, recording: Recording, result: Run) -> dict[str, Array]:
    """Return the figures of a run that did not fail; m and deg and their squares, s, 1/s; NIS summed over time."""
    steady = result.t > scene.steady_from
    known = np.where(steady[:, None], result.nis_dof, 0)
    vehicles = range(len(scene.vehicles))
    relative = np.array([_relative(recording, result, i) for i in vehicles]).T
    windows = [window.ticks(result.t) for window in scene.windows]
    return {
        "position_mse": result.mean(result.position_error**2, steady),
        "orientation_mse": result.mean(result.orientation_error**2, steady),
        "anees": result.mean(result.nees, steady) / result.nees_dof,
        "window_mse": np.array([result.mean(result.position_error**2, ticks) for ticks in windows]).T,
        "window_anees": np.array([result.mean(result.nees, ticks) for ticks in windows]).T / result.nees_dof,
        "nis": np.where(known > 0, result.nis, 0.0).sum(axis=0),
        "nis_dof": known.sum(axis=0).astype(float),
        "settle_time": np.array([_settling(result, i, SETTLED) for i in vehicles]),
        "converge_time": np.array([_settling(result, i, CONVERGED) for i in vehicles]),
        "rate": np.array([_rate(result, i) for i in vehicles]),
        "diverged": diverged(_last(result.position_error), _last(result.orientation_error)),
        "ate": np.array([absolute_error(recording.truth.position[:, i], result.position[:, i]) for i in vehicles]),
        "rpe": relative[0],
        "rpe_orientation": relative[1],
    }


def _relative(recording: Recording, result: Run, i: int) -> tuple[float, float]:
    """Return the relative trajectory error of one vehicle, m and deg."""
    delta, truth = max(1, round(RELATIVE_DELTA / recording.dt)), recording.truth
    poses = truth.rotation[:, i], truth.position[:, i], result.rotation[:, i], result.position[:, i]
    return relative_error(*poses, delta)


def _settling(result: Run, i: int, tolerance: SettlingTolerance) -> float:
    """Return when one vehicle settles, s, judged where the truth is known."""
    judged = result.judged[:, i]
    if not judged.any():
        return float("nan")
    errors = result.position_error[judged, i], result.orientation_error[judged, i]
    return float(settling_time(result.t[judged], *errors, tolerance))


def _rate(result: Run, i: int) -> float:
    judged = result.judged[:, i]
    return fit_exponential_rate(result.t[judged], result.position_error[judged, i]).rate if judged.any() else np.nan


def _last(error: Array) -> Array:
    """Return (N,) the last error that is known."""
    known = np.isfinite(error)
    last = len(error) - 1 - np.argmax(known[::-1], axis=0)
    return np.asarray(error[last, np.arange(error.shape[1])])


def _series(recording: Recording, result: Run) -> Series:
    kept = kept_ticks(recording)
    std = position_std(result.covariance[kept], result.coordinates, result.rotation[kept], result.position[kept])
    return Series(result.position_error[kept], std, result.nees[kept])
