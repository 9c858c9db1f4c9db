"""Judgement of one record: the errors of every observer against the truth and the bounds."""

import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import compress, pairwise
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.bench.executors import Executor, Local, Pool
from coopenv.bench.observers.findings import findings_on
from coopenv.bench.observers.sources import RecordSource
from coopenv.estimation.metrics import (
    CONVERGED,
    SETTLED,
    absolute_error,
    diverged,
    fit_exponential_rate,
    mean_or_nan,
    position_std,
    relative_error,
    settling_time,
)
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.poses import Array
from coopenv.estimation.trajectory import RecordedGeometry
from coopenv.observers.bound import Bound, cramer_rao, cramer_rao_ancestors, relative_information
from coopenv.observers.contract import Factory
from coopenv.observers.isolation import started
from coopenv.observers.recording import Recording
from coopenv.observers.runner import PLANAR_STATES, Run, run
from coopenv.observers.sensed import Truth

STEADY = "steady"


class TimeWindow(NamedTuple):
    """A stretch of a run, its start left out and its end included, s."""

    start: float
    end: float
    steady: bool = False

    @property
    def name(self) -> str:
        """Name of the window in tables."""
        return STEADY if self.steady else f"{self.start:g}-{self.end:g} s"

    def ticks(self, t: Array) -> NDArray[np.bool_]:
        """Return flags of the times (K,), s, within the window."""
        return np.asarray((t > self.start) & (t <= self.end))


def windows_of(edges: Iterable[float], steady_from: float, end: float) -> tuple[TimeWindow, ...]:
    """Return the windows between edges, s, as far as a run goes, and the steady state."""
    between = [TimeWindow(start, min(stop, end)) for start, stop in pairwise(edges) if start < end]
    return (*between, TimeWindow(steady_from, end, steady=True))


BOUNDS = ("joint", "ancestors", "neighbours known")
"""Bounds of a position: joint over all vehicles, over the vehicle and its ancestors, with given neighbours' poses."""


@dataclass(frozen=True)
class RecordProperties:
    """Properties of the record, the same for all observers; NaN where unknown."""

    vehicles: tuple[str, ...]
    """N of which any true pose is known; the others are not judged."""
    windows: tuple[TimeWindow, ...]
    """W stretches that are judged one by one, the steady state last."""
    bounds: Array
    """Variances (3, N, W), m^2, of `BOUNDS` in each window."""
    gramians: Array
    """(2, N) least eigenvalues over the run: about the map origin, mixed units; about the vehicle, no unit."""
    t: Array
    """(S,) s, instants that figures show."""
    bound: Array
    """(S, N) m, joint."""
    paper_noise: bool
    """True for bearing noise on the image plane, which off the optical axis is below the bound's assumption."""
    figures: tuple[float, ...] = ()
    """Figures in which another record differs: bearings, deliveries, and the root mean squares of bearings along x, of
    measured velocities, m/s, and of the last true positions, m."""
    without_truth: tuple[str, ...] = ()
    """Vehicles that are not judged."""

    @property
    def steady_from(self) -> float:
        """Start of the steady state, s."""
        return self.windows[-1].start


class Series(NamedTuple):
    """Time series of the figures, at `RecordProperties.t`; arrays (S, N)."""

    position_error: Array  # m
    position_std: Array  # m, NaN where the observer states no covariance
    nees: Array


@dataclass(frozen=True)
class JudgedRun:
    """One observer on one record."""

    variant: str
    observer: str
    scene: RecordProperties
    measures: Mapping[str, Array]
    """Arrays (N,) by name, (N, W) for names in `IN_WINDOWS`, see `_measures`; costs alone where it failed."""
    nees_dof: int
    failure: str
    series: Series
    stanford: Array
    """(B, B) vehicle ticks by horizontal error and protection level, both in bins of `LEVEL_BINS`; level known."""
    findings: tuple[str, ...] = ()
    """Mistakes of the observer, see `findings_on`; empty where it was not examined."""

    def measured(self, name: str) -> Array:
        """Return the figures of the vehicles; NaN where the observer failed, which counts as diverged."""
        if name in self.measures:
            return self.measures[name]
        shape = (len(self.scene.vehicles), len(self.scene.windows))
        return np.full(shape if name in IN_WINDOWS else shape[:1], 1.0 if name == "diverged" else np.nan)


IN_WINDOWS = ("position_mse", "anees")
LEVEL_BINS = np.logspace(-3.0, 2.0, 51)
"""m; errors and protection levels beyond either end count in the outermost bin."""
SERIES_TICKS = 250  # instants that are kept for figures
MOST_KEPT = 2  # bounds of records; those of many vehicles take minutes, and often every seed has the same

_kept: dict[bytes, list[Bound]] = {}


def scene_of(recording: Recording, steady_from: float, edges: Sequence[float] = ()) -> RecordProperties:
    """Return the bounds and the observability of a record, `edges` being those of the windows to judge it in, s.

    The noise of recorded robots is not known, and so neither is their bound.
    """
    names = tuple(setup.name for setup in recording.setups)
    kept, known = kept_ticks(recording), bool(recording.truth.known[:, ~recording.left_out].all())
    windows = windows_of(edges, steady_from, float(recording.t[-1]))
    if (out := recording.left_out).any():  # at any pose, as they have no part in measurements
        R, p = (np.array(values) for values in (recording.truth.rotation, recording.truth.position))
        R[:, out], p[:, out] = np.eye(3), 0.0
        recording = replace(recording, truth=Truth(R, p))
    within = np.full((len(BOUNDS), len(names), len(windows)), np.nan)
    bound, gramians = np.full((len(kept), len(names)), np.nan), np.full((2, len(names)), np.nan)
    if known and not recording.on_a_plane:
        bounds = _bounds(recording)
        bound = bounds[0].position[kept]
        ticks = [window.ticks(recording.t) for window in windows]
        means = [[mean_or_nan(of.position[chosen] ** 2) for chosen in ticks] for of in bounds]
        within = np.array(means).swapaxes(1, 2)
    if known:
        more = relative_information(recording) if recording.readings else None
        seen = analyse_observability(_geometry(recording), more=more)
        gramians = np.array([v.min(axis=0, initial=np.inf) for v in (seen.min_eigenvalue, seen.local_eigenvalue)])
    paper_noise = any(setup.noise.image_axis is not None for setup in recording.setups)
    judged = judged_vehicles(recording) & ~out
    arrays = within[:, judged], gramians[:, judged], recording.t[kept], bound[:, judged]
    own, others = (tuple(compress(names, part)) for part in (judged, ~(judged | out)))
    return RecordProperties(own, windows, *arrays, paper_noise, figures_of(recording), others)


def judged_vehicles(recording: Recording) -> NDArray[np.bool_]:
    """Return (N,) which vehicles have any known true pose."""
    return np.asarray(recording.truth.known.any(axis=0))


def figures_of(recording: Recording) -> tuple[float, ...]:
    """Return the figures of a record, see `RecordProperties`."""
    r = recording
    squares = r.bearings[r.visible][:, 0], r.velocity, r.truth.position[-1]
    roots = (float(np.sqrt(np.mean(values**2))) if values.size else 0.0 for values in squares)
    return float(r.visible.sum()), float((np.diff(r.inbox_tick, axis=0) > 0).sum()), *roots


def _geometry(recording: Recording) -> RecordedGeometry:
    """Return a record as `analyse_observability` reads it."""
    truth, marker = recording.truth, np.array([setup.marker for setup in recording.setups])
    seen = truth.position + (truth.rotation @ marker[..., None])[..., 0]  # the points of vehicles that cameras see
    targets = np.concatenate([recording.landmarks, seen], axis=1)
    names = np.array([setup.name for setup in recording.setups])
    return RecordedGeometry(recording.t, truth.position, targets, recording.visible, names)


def kept_ticks(recording: Recording) -> np.ndarray:
    """Return the ticks of which figures show something."""
    return np.unique(np.linspace(0, recording.ticks - 1, SERIES_TICKS).round().astype(int))


def _bounds(recording: Recording) -> list[Bound]:
    """Return the bounds of `BOUNDS`; of a record that differs from a recent one in noise alone, those of that one."""
    key = _fingerprint(recording)
    if key not in _kept:
        _kept[key] = [cramer_rao(recording), cramer_rao_ancestors(recording), cramer_rao(recording, joint=False)]
        for old in list(_kept)[:-MOST_KEPT]:
            del _kept[old]
    return _kept[key]


def _fingerprint(recording: Recording) -> bytes:
    """Return a digest of everything that bounds depend on: truth, visibility, noise, and what is known at the start."""
    r = recording
    setups = [(s.noise, s.landmarks, s.targets, s.marker, s.lever_arm, s.sensors) for s in r.setups]
    arrays = (r.truth.rotation, r.truth.position, r.visible, r.landmarks, r.due, r.start_covariance)
    measured = {name: np.isfinite(values).all(axis=-1) for name, values in r.readings.items()}
    twists = (r.velocity, r.angular_velocity) if r.readings else ()  # by which the bound moves sensors
    return sha256(pickle.dumps((r.dt, setups, arrays, measured, twists))).digest()


RELATIVE_DELTA = 1.0  # s between the poses of a pair of the relative trajectory error


@dataclass(frozen=True)
class Task:
    """One record with its observers, the parts of the task; small, because it is sent to a worker."""

    source: RecordSource
    variant: str
    seed: int
    observers: Mapping[str, str | Factory]
    """Observers by name, as `registry.find` accepts them in another process, or `Isolated` ones."""
    steady_from: float | None
    edges: tuple[float, ...] = ()
    """Edges of the windows that are judged one by one, s."""
    examined: bool = False
    """Whether mistakes of the observers are sought, too."""

    @property
    def world(self) -> tuple[RecordSource, str]:
        """Source and variant, which the records of all seeds share."""
        return self.source, self.variant

    def parts(self, done: int = 0, ended: Mapping[str, str] = MappingProxyType({})) -> Iterator[JudgedRun | None]:
        """Make the record, and run all observers but the first `done` on it; observers in `ended` fail for it."""
        recording = self.source.recording(self.variant, self.seed)
        scene = scene_of(recording, self.source.steady_from(self.steady_from, recording), self.edges)
        yield None
        for name, factory in [*self.observers.items()][done:]:
            if name in ended:
                dof = len(PLANAR_STATES) if recording.on_a_plane else 6
                yield failed_run(self.variant, name, scene, dof, ended[name], {})
            else:
                with started(factory) as observer:
                    result = run(observer, recording)
                    found = findings_on(observer, recording, result, scene.steady_from) if self.examined else ()
                sample = sample_of(self.variant, name, scene, recording, result)
                yield replace(sample, findings=found)


def judge(task: Task) -> list[JudgedRun]:
    """Make the record and run every observer of a task on it."""
    return [run for run in task.parts() if run is not None]


def judge_all(executor: Executor, tasks: Sequence[Task], on_done: Callable[[int], None]) -> list[list[JudgedRun]]:
    """Judge the observers of all tasks; if the executor has limits, only observers that exceed one fail.

    An observer that was ended is not started again in the same variant; one that took too long not at all.
    """
    if isinstance(executor, Local) and executor.limits is not None:
        return Pool(tasks, executor.jobs, executor.limits).run(on_done)
    return executor.map(judge, tasks, on_done)


def failed_run(
    variant: str,
    observer: str,
    scene: RecordProperties,
    dof: int,
    reason: str,
    costs: Mapping[str, Array],
) -> JudgedRun:
    """Return a run that failed, of which nothing but its costs is known."""
    unknown = Series(*np.full((3, len(scene.t), len(scene.vehicles)), np.nan))
    return JudgedRun(variant, observer, scene, costs, dof, reason, unknown, np.zeros((len(LEVEL_BINS) - 1,) * 2))


def sample_of(variant: str, observer: str, scene: RecordProperties, recording: Recording, result: Run) -> JudgedRun:
    """Judge one run."""
    judged = judged_vehicles(recording)
    costs = {"bytes_per_s": result.bytes_per_second[judged], "us_per_update": result.microseconds_per_update[judged]}
    if result.failure:
        return failed_run(variant, observer, scene, result.nees_dof, result.failure, costs)
    kept = kept_ticks(recording)
    std = position_std(result.covariance[kept], result.coordinates, result.rotation[kept], result.position[kept])
    measures = costs | {name: values[judged] for name, values in _measures(scene, recording, result).items()}
    series = Series(*(values[:, judged] for values in (result.position_error[kept], std, result.nees[kept])))
    error, level = horizontal_error(recording, result), result.protection_level[..., 0]
    counted = result.judged & np.isfinite(level)
    error, level = (np.clip(values[counted], LEVEL_BINS[0], LEVEL_BINS[-1]) for values in (error, level))
    stanford = np.histogram2d(error, level, bins=[LEVEL_BINS, LEVEL_BINS])[0]
    return JudgedRun(variant, observer, scene, measures, result.nees_dof, "", series, stanford)


def horizontal_error(recording: Recording, result: Run) -> Array:
    """Return (K, N) the horizontal distance of the estimates from the truth, m."""
    offset = (result.position - recording.truth.position)[..., :2]
    return np.asarray(np.linalg.norm(offset, axis=-1))


START = 1.0  # s; the first estimates are drawn, so until then an error counts only above that of the start


def largest_after_start(t: Array, error: Array) -> Array:
    """Return (N,) the largest of errors (K, N) after `START`, or above the first error; NaN where none is known."""
    counted = np.where((t > START)[:, None] | (error > error[0]), error, np.nan)
    return np.where(
        np.isfinite(counted).any(axis=0), np.nan_to_num(counted, nan=-np.inf).max(axis=0, initial=-np.inf), np.nan
    )


def level_measures(error: Array, result: Run) -> dict[str, Array]:
    """Return the figures of the protection levels (N,), over the whole run; NaN where none is stated.

    Shares of the ticks with a stated level in which the horizontal `error` (K, N), m, and the angle exceed it, and in
    which it is unknown; and the median known level over the 95th percentile of the horizontal error in the same ticks.
    """
    level, angle = result.protection_level, np.radians(result.orientation_error)
    stated = np.asarray(~np.isnan(level).any(axis=-1))
    known = result.judged & stated & np.isfinite(level[..., 0])
    ratio = np.full(known.shape[1], np.nan)
    for i in np.flatnonzero(known.any(axis=0)):
        reached = float(np.quantile(error[known[:, i], i], 0.95))
        ratio[i] = np.median(level[known[:, i], i, 0]) / reached if reached > 0.0 else np.nan
    counted = {
        "level_exceeded": error > level[..., 0],
        "angle_level_exceeded": angle > level[..., 1],
        "level_unknown": ~np.isfinite(level).all(axis=-1),
    }
    shares = {name: result.mean(np.asarray(ticks, float), stated) for name, ticks in counted.items()}
    return {**shares, "level_over_e95": ratio}


def _measures(scene: RecordProperties, recording: Recording, result: Run) -> dict[str, Array]:
    """Return the figures of a run that did not fail; m and deg and their squares, s, 1/s; NIS summed over time."""
    windows = [window.ticks(result.t) for window in scene.windows]
    dof = np.where(windows[-1][:, None], result.nis_dof, 0)
    errors = result.position_error, result.orientation_error
    figures = {
        "position_mse": np.array([result.mean(errors[0] ** 2, ticks) for ticks in windows]).T,
        "orientation_mse": result.mean(errors[1] ** 2, windows[-1]),
        "anees": np.array([result.anees_in(ticks) for ticks in windows]).T,
        "nis": np.where(dof > 0, result.nis, 0.0).sum(axis=0),
        "nis_dof": dof.sum(axis=0).astype(float),
        "worst": largest_after_start(result.t, errors[0]),
        "diverged": diverged(*errors),
        **level_measures(horizontal_error(recording, result), result),
    }
    single = [_vehicle_measures(recording, result, i) for i in range(len(recording.setups))]
    return figures | {name: np.array([found[name] for found in single]) for name in single[0]}


def _vehicle_measures(recording: Recording, result: Run, i: int) -> dict[str, float]:
    """Return the figures of one vehicle over the whole run; times and rates are judged where the truth is known."""
    judged, truth = result.judged[:, i], recording.truth
    t, position, orientation = (
        a[judged] for a in (result.t, result.position_error[:, i], result.orientation_error[:, i])
    )
    settled, converged, rate = np.nan, np.nan, np.nan
    if judged.any():
        settled, converged = (float(settling_time(t, position, orientation, below)) for below in (SETTLED, CONVERGED))
        rate = fit_exponential_rate(t, position).rate
    poses = truth.rotation[:, i], truth.position[:, i], result.rotation[:, i], result.position[:, i]
    relative = relative_error(*poses, max(1, round(RELATIVE_DELTA / recording.dt)))
    ate = absolute_error(truth.position[:, i], result.position[:, i])
    found = {"settle_time": settled, "converge_time": converged, "rate": rate, "ate": ate}
    return found | {"rpe": relative.position, "rpe_orientation": relative.orientation}
