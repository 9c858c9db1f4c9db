"""One record, judged: what every observer makes of it, against the truth and the bounds."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from coopenv.bench.observers.samples import Sample, Scene, Series
from coopenv.bench.observers.scene import kept_ticks, scene_of
from coopenv.bench.observers.sources import Source
from coopenv.estimation.arrays import Array
from coopenv.estimation.consistency import diverged, position_std
from coopenv.estimation.metrics import CONVERGED, SETTLED, SettlingTolerance, fit_exponential_rate, settling_time
from coopenv.estimation.trajectory_error import absolute_error, relative_error
from coopenv.observers.contract import Factory
from coopenv.observers.recording import Recording
from coopenv.observers.runner import Run, run

RELATIVE_DELTA = 1.0  # s between the poses of a pair of the relative trajectory error


@dataclass(frozen=True)
class Task:
    """One record and who runs on it; small, so that it travels to a worker."""

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
    recording, lie = task.source.recording(task.variant, task.seed)
    steady_from = task.source.steady_from(task.steady_from, recording)
    scene = scene_of(recording, steady_from, task.edges)
    return [
        sample_of(task.variant, name, scene, recording, run(factory, recording, lie))
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
    told = np.where(steady[:, None], result.nis_dof, 0)
    vehicles = range(len(scene.vehicles))
    relative = np.array([_relative(recording, result, i) for i in vehicles]).T
    windows = [window.ticks(result.t) for window in scene.windows]
    return {
        "position_mse": result.mean(result.position_error**2, steady),
        "orientation_mse": result.mean(result.orientation_error**2, steady),
        "anees": result.mean(result.nees, steady) / result.nees_dof,
        "window_mse": np.array([result.mean(result.position_error**2, ticks) for ticks in windows]).T,
        "window_anees": np.array([result.mean(result.nees, ticks) for ticks in windows]).T / result.nees_dof,
        "nis": np.where(told > 0, result.nis, 0.0).sum(axis=0),
        "nis_dof": told.sum(axis=0).astype(float),
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
