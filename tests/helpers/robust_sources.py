"""Faults of sources of information in recordings, and what the monitors of `robust` make of them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from benchmarks.robust.scenes import with_liars
from coopenv.base.errors import ScenarioWarning
from coopenv.observers import Message, Recording, Run, Tick, run
from coopenv.observers.contract import Estimate
from coopenv.observers.group import Tamper
from coopenv.observers.robust.memory import MOUNTING
from coopenv.observers.robust.messages import from_six
from coopenv.observers.robust.sources import NO_TARGET, VELOCITY
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from tests.helpers.robust_ticks import OpenRobust, Pose


@cache
def seen(horizon: float, seed: int) -> Recording:
    """Return a recording of that scene at 20 Hz."""
    return record(with_liars(horizon=horizon, overrides={"rates.camera": 20.0, "rates.odometry": 60.0}), seed)


@cache
def busy(horizon: float, seed: int) -> Recording:
    """Return a recording of the paper's scene, in which many see two targets or three, at 20 Hz."""
    slow = {"horizon": horizon, "rates.camera": 20.0, "rates.odometry": 60.0}
    return record(load_scenario("busy_intersection_tracking", slow), seed)


@cache
def fast(horizon: float, seed: int, vehicles: int = 3) -> Recording:
    """Return vehicles at 25 m/s between pairs of landmarks, 10 frames a second; each sees up to four."""
    slow = {"horizon": horizon, "rates.camera": 10.0, "rates.odometry": 100.0}
    raw = load_scenario("busy_intersection_tracking", slow).model_dump()
    template, places = raw["vehicles"][0], range(0, round(25.0 * horizon) + 80, 80)
    raw["landmarks"] = [
        {"name": f"{side}{y}", "position": (x, y, z)} for y in places for side, x, z in (("W", -9, 4.0), ("E", 9, 6.0))
    ]
    names = [landmark["name"] for landmark in raw["landmarks"]]
    raw["vehicles"] = [
        {
            **template,
            "initial_pose": {"position": (2.0, -20.0 * n, 1.5)},
            "motion": {"kind": "constant", "linear": (0.0, 25.0, 0.0)},
            "neighbours": (*names, *(f"vehicle_{m + 1}" for m in range(n))),
        }
        for n in range(vehicles)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)  # that it is far from the map's origin
        recording = record(Scenario(**raw), seed)
    away = np.abs(recording.landmarks[:, None, :, 1] - recording.truth.position[:, :, None, 1])
    visible = recording.visible.copy()
    visible[:, :, : len(names)] &= away < 60.0
    return replace(recording, visible=visible, bearings=np.where(visible[..., None], recording.bearings, np.nan))


def wrong_landmark(
    recording: Recording, landmark: int, offset: ArrayLike, start: float = 0.0, end: float = np.inf
) -> Recording:
    """Return a recording in whose map a landmark is off from a time to another, s."""
    landmarks = recording.landmarks.copy()
    landmarks[(recording.t >= start) & (recording.t < end), landmark] += offset
    return replace(recording, landmarks=landmarks)


def hidden_landmark(recording: Recording, landmark: int, start: float = 0.0) -> Recording:
    """Return a recording in which a landmark is out of all views from a time on, s."""
    late = (recording.t >= start)[:, None, None]
    visible = recording.visible & ~(late & (np.arange(recording.visible.shape[-1]) == landmark))
    return replace(recording, visible=visible, bearings=np.where(visible[..., None], recording.bearings, np.nan))


def wrong_velocity(recording: Recording, offset: ArrayLike) -> Recording:
    """Return a recording whose odometry has an error of its velocity, m/s, body."""
    translation = recording.translation.copy()
    translation[1:] += np.asarray(offset) * recording.dt
    return replace(recording, translation=translation, velocity=recording.velocity + offset)


@dataclass
class Lies:
    """A vehicle says that it is elsewhere by an offset, for some time; its odometry agrees with what it says."""

    sender: int
    offset: np.ndarray  # m, map
    start: float = 0.0  # s
    end: float = np.inf

    def __call__(self, vehicle: int, time: float, observer: Any, message: Message) -> Message:
        if vehicle != self.sender or not self.start <= time < self.end:
            return message
        if message.position is None or message.rotation is None:
            return message
        R, p = from_six(np.asarray(message.extra["odometry"], float))
        odometry = np.concatenate([Rotation.from_matrix(R).as_rotvec(), p + R @ message.rotation.T @ self.offset])
        extra = {**message.extra, "odometry": odometry.astype(np.float32)}
        return replace(message, position=message.position + self.offset, extra=extra)


@dataclass(frozen=True)
class Watched:
    """A run, and the monitors after each of its K ticks, of N vehicles."""

    run: Run
    recording: Recording
    source: np.ndarray  # (K, N, Q) records
    sensitivity: np.ndarray  # (K, N, Q, 6, 3) of the own error
    calibration: np.ndarray  # (K, N, 3) records: the vehicle itself, and the members that stand for its errors

    def of(self, name: str, vehicle: int, target: int) -> np.ndarray:
        """Return (K, ...) a field of the monitor of a target, or its sensitivity; NaN without a slot."""
        held = self.source["target"][:, vehicle] == target
        held[:, VELOCITY] = target == NO_TARGET
        values = self.sensitivity if name == "sensitivity" else self.source[name].astype(float)
        found = values[:, vehicle][np.arange(len(held)), np.argmax(held, axis=1)]
        found[~held.any(axis=1)] = np.nan
        return np.asarray(found)

    def pose(self, k: int, vehicle: int) -> Pose:
        """Return the estimate of a vehicle at a tick."""
        return self.run.rotation[k, vehicle], self.run.position[k, vehicle]

    def changes(self, vehicle: int, target: int) -> list[float]:
        """Return when a vehicle excludes and readmits a target in turn, s."""
        excluded = np.nan_to_num(self.of("excluded", vehicle, target))
        return [float(t) for t in self.recording.t[1:][np.diff(excluded) != 0]]

    def excluded(self) -> set[tuple[int, int]]:
        """Return (vehicle, target) of all exclusions; -1 for the odometry."""
        ticks, vehicles, slots = np.nonzero(np.diff(self.source["exclusions"], axis=0) > 0)
        return {
            (int(v), int(self.source["target"][k + 1, v, q])) for k, v, q in zip(ticks, vehicles, slots, strict=True)
        }


def watch(recording: Recording, tamper: Tamper | None = None) -> Watched:
    """Run `robust` and log its monitors."""
    K, N = recording.ticks, len(recording.setups)
    log: dict[str, Any] = {}

    class Logging(OpenRobust):
        def update(self, tick: Tick) -> Estimate:
            estimate = super().update(tick)
            memory = self.memory
            own = ("calibration", memory.member[: MOUNTING + 1])
            for name, values in (("source", memory.source), ("sensitivity", memory.sensitivity[:, 0]), own):
                if name not in log:
                    log[name] = np.zeros((K, N, *values.shape), values.dtype)
                log[name][tick.index, self.setup.vehicle] = values
            return estimate

    result = run(Logging, recording, tamper)
    assert not result.failure
    return Watched(result, recording, log["source"], log["sensitivity"], log["calibration"])
