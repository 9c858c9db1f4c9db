"""Measurements of all vehicles at one tick, and their checks."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coopenv.base.errors import CoopenvError
from coopenv.base.sections import LARGEST
from coopenv.estimation.poses import Array
from coopenv.measurements.sensor import Reading, Sensor
from coopenv.observers.arrays import ARRAYS, KINDS_OF_TICKS, invalid_rows, misshapen, sizes_of
from coopenv.observers.contract import ObserverInit, Received, Setup, Tick, sealed
from coopenv.observers.faults import Interference
from coopenv.observers.readings import problems_of_readings


@dataclass(frozen=True)
class Truth:
    """True states, which no observer reads, of one tick or (K, ...) of several; NaN if unknown."""

    rotation: Array  # (..., N, 3, 3) body to map
    position: Array  # (..., N, 3) map, m

    @property
    def known(self) -> NDArray[np.bool_]:
        """(..., N) where the whole pose is known."""
        whole = np.concatenate([self.rotation, self.position[..., None]], axis=-1)
        return np.asarray(np.isfinite(whole).all(axis=(-1, -2)))


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Measurements by N vehicles of T targets, the first L of which are landmarks; (K, ...) for several ticks."""

    rotation: Array  # (..., N, 3, 3) odometry increments since the last tick
    translation: Array  # (..., N, 3) m
    velocity: Array  # (..., N, 3) m/s, last odometry sample
    angular_velocity: Array  # (..., N, 3) rad/s
    bearings: Array  # (..., N, T, 3) camera -> target, body frame, NaN where not measured
    visible: NDArray[np.bool_]  # (..., N, T)
    landmarks: Array  # (..., L, 3) map, m
    pan: Array | None = None  # (..., N) rad, by which cameras are turned to the left; None: 0
    bearing_age: Array | None = None  # (..., N) s since the frame was exposed; None: 0
    readings: Mapping[str, Array] = field(default_factory=dict)
    """(..., N, T, size) of each sensor beside the camera, by its name; (..., N, 1, size) of one that measures the map.
    NaN where nothing was measured."""

    def measured(self) -> dict[str, Array]:
        """Return the arrays of this class that are there, by name."""
        return {name: value for name in MEASURED if (value := getattr(self, name)) is not None}

    def readings_at(self, ticks: Any) -> dict[str, Array]:
        """Return the readings of one or some of several ticks."""
        return {name: values[ticks] for name, values in self.readings.items()}

    def filled(self, name: str) -> NDArray[Any]:
        """Return an array; if it is absent, one of the value that stands for it."""
        value: NDArray[Any] | None = getattr(self, name)
        if value is None:
            ticks, sizes = self.visible.shape[:-2], {"N": self.visible.shape[-2], "T": self.visible.shape[-1]}
            shape = ARRAYS[name].shape({**sizes, "L": self.landmarks.shape[-2]})
            value = np.full((*ticks, *shape), ARRAYS[name].optional, ARRAYS[name].dtype)
        return value


@dataclass(frozen=True, kw_only=True)
class Sensed(Measurements):
    """Measurements of N vehicles at one tick; T targets, the first L of which are landmarks. Read-only.

    Ticks are the frames of the scenario's camera rate, one after the other: tick k is due at k / rate. A vehicle's
    row holds its measurements at that time; the row of a vehicle without data is not read.
    """

    index: int  # k
    dt: float  # s, between ticks
    due: bool = True  # whether the scenario's observer rate asks for a correction
    time: float | None = None  # s since the reset on the source's clock; None: index * dt
    odometry_age: Array | None = None  # (N,) s since the last odometry sample; None: 0
    missing: NDArray[np.bool_] | None = None  # (N,) vehicles without data; None: none
    late: NDArray[np.bool_] | None = None  # (N,) vehicles with data after the deadline; None: none
    truth: Truth | None = None  # of this tick; None: not known
    inbox_tick: NDArray[np.int64] | None = None
    """(N receiver, N sender) tick of sending of the last message that arrived, -1: none, where the source knows what
    its radio delivered; None: the scenario's radio decides. The contents are those of the senders' observers, which
    keep it for `v2x.delay` ticks (at least one)."""
    messages: Mapping[tuple[int, int], Received] = field(default_factory=dict)
    """(receiver, sender) to a message that arrived since the last tick from a vehicle that is estimated elsewhere."""

    def tick(self, setup: Setup, messages: Mapping[int, Received], interference: Interference | None = None) -> Tick:
        """Return the read-only tick of one vehicle with its messages, and with the errors of its map."""
        i, landmarks = setup.vehicle, self.landmarks
        if interference is not None:
            landmarks = sealed(landmarks + interference.map_error_of(i, self.index))
        return Tick(
            index=self.index,
            time=self.index * self.dt if self.time is None else self.time,
            dt=self.dt,
            rotation=self.rotation[i],
            translation=self.translation[i],
            velocity=self.velocity[i],
            angular_velocity=self.angular_velocity[i],
            targets=sealed(setup.targets[:]),
            bearings=sealed(self.bearings[i].take(setup.targets, axis=0)),
            valid=sealed(self.visible[i].take(setup.targets)),
            landmarks=landmarks,
            messages=messages,
            lever_arm=sealed(setup.lever_arm[:]),
            noise=setup.noise.moving(self.velocity[i], self.angular_velocity[i]),
            due=self.due,
            readings=tuple(self.reading(setup, sensor) for sensor in setup.sensors),
            landmark_rotation=setup.landmark_rotation,
            landmark_names=setup.target_names[: setup.landmarks],
            bearing_age=0.0 if self.bearing_age is None else float(self.bearing_age[i]),
        )

    def reading(self, setup: Setup, sensor: Sensor) -> Reading:
        """Return what a sensor of a vehicle has measured."""
        of_vehicle = self.readings[sensor.name][setup.vehicle]
        return Reading(sensor, sealed(of_vehicle[np.maximum(sensor.targets, 0)]))


def is_due(index: ArrayLike, ratio: float) -> NDArray[np.bool_]:
    """Return at which ticks a correction at `ratio` times the camera's rate is due; at the start none is."""
    k = np.asarray(index)
    return np.asarray(np.floor(k * ratio + 1e-9) > np.floor(np.maximum(k - 1, 0) * ratio + 1e-9))


MEASURED = tuple(field.name for field in fields(Measurements) if field.name in ARRAYS)
"""Arrays of measurements."""
REQUIRED = tuple(name for name in MEASURED if ARRAYS[name].optional is None)
"""Arrays of measurements that every tick has."""
ROWS_OF_MISSING = tuple(
    name for name, spec in ARRAYS.items() if "N" in spec.axes and (name in MEASURED or not spec.recorded)
)
"""Arrays of a tick of which the row of a missing vehicle is not read."""


def check_tick(tick: Sensed, index: int, observer_init: ObserverInit) -> None:
    """Refuse a tick that is not number `index` or holds what no kernel may read; rows of the missing are not read.

    Raises:
        CoopenvError: one line that names tick, field and vehicle.
    """
    if tick.index != index:
        raise CoopenvError(f"tick {index}: index: got {tick.index!r:.40}")
    if not math.isclose(tick.dt, observer_init.dt, rel_tol=1e-6):
        raise CoopenvError(f"tick {index}: dt: expected {observer_init.dt:.6g} s, got {tick.dt!r:.40}")
    if tick.time is not None and not 0.0 <= tick.time <= LARGEST:
        raise CoopenvError(f"tick {index}: time: expected s since the reset, got {tick.time!r:.40}")
    names = [name for name, spec in ARRAYS.items() if spec.axes[0] == "K" and name != "due"]
    given = {name: attrgetter(name)(tick) for name in names if tick.truth is not None or "." not in name}
    given = {name: value for name, value in given.items() if value is not None or name in REQUIRED}
    for problem in misshapen(given, sizes_of(observer_init.setups), KINDS_OF_TICKS):
        raise CoopenvError(f"tick {index}: {problem}")
    absent = given.get("missing", np.zeros(len(observer_init.setups), bool))
    for problem in problems_of_readings(tick.readings, observer_init.setups, ignored=np.asarray(absent)):
        raise CoopenvError(f"tick {index}: {problem}")
    seen = tick.visible & ~absent[:, None]
    given |= {"visible": seen, "bearings": np.where(seen[..., None], tick.bearings, np.nan)}
    problems = invalid_rows(given, {"now": index, "period": 1}, ticks=False)
    for name, valid, problem in chain(problems, _invalid_messages(tick, len(absent))):
        valid = valid | absent if valid.ndim and name in ROWS_OF_MISSING else valid
        if not valid.all():
            whose = f" of {observer_init.setups[int(np.argmin(valid))].name}" if valid.ndim else ""
            raise CoopenvError(f"tick {index}: {name}{whose}: {problem}")


def _invalid_messages(tick: Sensed, vehicles: int) -> Iterator[tuple[str, Any, str]]:
    if tick.messages and tick.inbox_tick is None:
        yield "messages", np.False_, "where some come from elsewhere, inbox_tick says what became of the others"
    known = range(vehicles)
    for (receiver, sender), received in tick.messages.items():
        possible = receiver in known and sender in known and receiver != sender
        yield "messages", np.bool_(possible), f"({receiver!r:.20}, {sender!r:.20}) are not two vehicles"
        yield "messages", (np.arange(vehicles) != receiver) | (received.age >= 0.0), "of negative age"
