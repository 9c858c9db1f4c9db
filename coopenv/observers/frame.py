"""The usable measurements of a frame, of the camera and of other sensors, as a table of NumPy records.

A frame with an age was taken by a camera at another place of the body, which has moved since: the table has the camera
and its bearings as the body of the tick would have them, and targets with a known velocity where they were.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.compiled import NUMBER, WHOLE, exp_so3, exp_translation
from coopenv.estimation.poses import IDENTITY, Array
from coopenv.measurements.kinds import MOST_ROWS
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.measurements.table import KINDS
from coopenv.observers.contract import Message, Tick

CAMERA = 0  # number of the camera among the sensors of a vehicle
OWN_KIND, BEARING, RANGE, RANGE_BEARING, POSITION, ATTITUDE, RELATIVE_POSE = range(7)
COMPILED = dict(zip(KINDS, range(BEARING, RELATIVE_POSE + 1), strict=False))
"""Kinds that compiled functions linearise; any other kind is linearised by its own functions in NumPy."""
BEARING_ROWS = 2
UNKNOWN_ANGLE = 0.5  # rad, a standard deviation from which on a sensor does not measure an angle

SENSOR = np.dtype(
    [
        ("kind", np.int64),
        ("rows", np.int64),
        ("position", np.float64, 3),  # in the body frame, m
        ("rotation", np.float64, (3, 3)),  # sensor to body
        ("variance", np.float64, MOST_ROWS),
        ("variance_by_distance", np.float64),  # beside it, per m^2
        ("angle", np.int64, MOST_ROWS),  # 1: the row measures an angle
    ],
    align=True,
)
ENTRY = np.dtype(
    [
        ("sensor", np.int64),  # its number
        ("target", np.int64),  # or `MAP`
        ("value", np.float64, MOST_ROWS),
        ("position", np.float64, 3),  # of the target as known or reported, map frame, m
        ("rotation", np.float64, (3, 3)),  # likewise, NaN or zero where not known
        ("velocity", np.float64, 3),  # likewise, map axes, m/s
        ("covariance", np.float64, (6, 6)),  # of turn and shift of the target in its axes, or in the map's if not known
        ("curvature", np.float64, MOST_ROWS),  # variances of second-order errors of the rows
    ],
    align=True,
)


RECORDS = {dtype: types.Array(numba.from_dtype(dtype), 1, "A", readonly=True) for dtype in (ENTRY, SENSOR)}
FRAME = types.Tuple((RECORDS[ENTRY], RECORDS[SENSOR], NUMBER, WHOLE))
"""The first fields of `UsableMeasurements`, for compiled functions."""
Frame = tuple[Any, Any, float, int]

ticks_of_own_kinds: WeakValueDictionary[int, Tick] = WeakValueDictionary()
"""Ticks with measurements of kinds that are not compiled, by `UsableMeasurements.own`."""


class UsableMeasurements(NamedTuple):
    """The usable measurements of a frame, m of them: those of the camera come first."""

    entries: NDArray[Any]  # (m,) `ENTRY`
    sensors: NDArray[Any]  # (s,) `SENSOR` of the vehicle, the camera first
    weight: float  # factor on the covariances of the targets; 0 if they count as known exactly
    own: int  # key of the tick if a sensor is of a kind that is not compiled, else 0
    messages: NDArray[Any]  # (m,) `Message`, None for landmarks
    tick: Tick

    @property
    def frame(self) -> Frame:
        """The arguments of compiled functions."""
        return self[:4]

    @property
    def targets(self) -> NDArray[np.int64]:
        """(m,) numbers of the targets."""
        targets: NDArray[np.int64] = self.entries["target"]
        return targets

    @property
    def bearings(self) -> Array:
        """(m, 3) unit vectors, body frame, of measurements of the camera."""
        return np.asarray(self.entries["value"][:, :3])

    @property
    def positions(self) -> Array:
        """(m, 3) of the targets as known or reported, map frame, m."""
        return np.asarray(self.entries["position"])

    @property
    def axes(self) -> Array:
        """(m, 3, 3) axes of the covariances of the targets, to the map."""
        R = self.entries["rotation"]
        known = (R[:, :, 0] ** 2).sum(axis=1) > 0.0
        return np.where(known[:, None, None], R, IDENTITY)

    def only(self, kept: NDArray[Any] | slice) -> "UsableMeasurements":
        """Return the measurements of a mask (m,), of numbers or of a range."""
        return self._replace(entries=self.entries[kept], messages=self.messages[kept])

    def of_camera(self) -> "UsableMeasurements":
        """Return the bearings of the camera."""
        return self.only(self.entries["sensor"] == CAMERA)._replace(sensors=self.sensors[:1])

    def exact(self) -> "UsableMeasurements":
        """Return the measurements as if the targets were known exactly."""
        return self._replace(weight=0.0)

    def inflated(self, factor: float) -> "UsableMeasurements":
        """Return the measurements with a factor on the covariances of their targets."""
        return self._replace(weight=factor * self.weight)


def measured_message(tick: Tick) -> Message:
    """Return the measurements of a tick as a message: the odometry sample, the bearings, and other readings."""
    odometry = np.concatenate([tick.angular_velocity, tick.velocity])
    extra = {"odometry": odometry, "bearings": tick.bearings[tick.valid]}
    return Message(extra=extra | {reading.sensor.name: reading.values[reading.valid] for reading in tick.readings})


def usable_measurements(tick: Tick, weighed: bool = True) -> UsableMeasurements | None:
    """Return the usable measurements of a frame, None without any; `weighed`: with the reported covariances."""
    seen = tick.usable()
    others = [*_other_measurements(tick)] if tick.readings else []
    if not (seen or others):
        return None
    count = len(seen)
    entries, messages = np.zeros(count + len(others), ENTRY), np.empty(count + len(others), object)
    targets, values, positions = entries["target"], entries["value"], entries["position"]
    for n, (target, bearing, position, message) in enumerate(seen):
        targets[n], values[n, :3], positions[n] = target, bearing, position
        if message is not None:
            messages[n] = message
            _put_report(entries, n, message)
            if "velocity" in message.extra:
                entries["velocity"][n] = np.nan_to_num(_velocity_of(message))
        elif tick.landmark_std:
            _put_accuracy(entries, n, tick)
    for n, (number, target, value, message) in enumerate(others, count):
        entries["sensor"][n], targets[n], values[n, : len(value)] = number, target, value
        if message is not None:
            messages[n], positions[n] = message, message.position
            entries["rotation"][n] = np.nan
            _put_report(entries, n, message)
            entries["velocity"][n] = _velocity_of(message)
        elif target != MAP:
            positions[n] = tick.landmarks[target]
            rotation = IDENTITY if tick.landmark_rotation is None else tick.landmark_rotation[target]
            entries["rotation"][n] = rotation
            entries["velocity"][n] = 0.0 if np.isfinite(rotation).all() else np.nan
            if tick.landmark_std:
                _put_accuracy(entries, n, tick)
    lever_arm, readings = np.asarray(tick.lever_arm, float), [reading.sensor for reading in tick.readings]
    if tick.bearing_age > 0.0:
        lever_arm = _dated(entries[:count], tick)
    sensors, compiled_alone = table_of_sensors(lever_arm.tobytes(), tick.noise.bearing_std, *readings)
    if not compiled_alone:
        ticks_of_own_kinds[id(tick)] = tick
    return UsableMeasurements(entries, sensors, float(weighed), 0 if compiled_alone else id(tick), messages, tick)


def _other_measurements(tick: Tick) -> Iterator[tuple[int, int, Array, Message | None]]:
    """Yield number of the sensor, target, value and message of every usable reading."""
    landmarks = len(tick.landmarks)
    for number, (sensor, values, _) in enumerate(tick.readings, CAMERA + 1):
        targets = sensor.targets.tolist()
        for n in np.flatnonzero(np.isfinite(values).all(axis=-1)).tolist():
            target, message = targets[n], None
            if target >= landmarks:
                received = tick.messages.get(target)
                if received is None or received.message.position is None:
                    continue
                message = received.message
            yield number, target, values[n], message


def _velocity_of(message: Message) -> Array:
    """Return the velocity (3,) of a target as reported, map axes, m/s, NaN where it is not."""
    velocity = np.asarray(message.extra.get("velocity", np.nan), float)
    return velocity if velocity.shape == (3,) else np.full(3, np.nan)


def _dated(bearings: NDArray[Any], tick: Tick) -> Array:
    """Change bearings (m,) to those of a frame with an age, and return the camera's place (3,) at that time, m."""
    turn = -tick.bearing_age * np.asarray(tick.angular_velocity, float)
    shift = exp_translation(turn, -tick.bearing_age * np.asarray(tick.velocity, float))
    R = exp_so3(turn)
    bearings["value"][:, :3] = bearings["value"][:, :3].dot(R.T)
    bearings["position"] -= tick.bearing_age * bearings["velocity"]
    return np.asarray(R.dot(np.asarray(tick.lever_arm, float)) + shift)


def _put_accuracy(entries: NDArray[Any], n: int, tick: Tick) -> None:
    """Write the covariance of a landmark's position on the map, and its axes."""
    target = int(entries["target"][n])
    if tick.landmark_rotation is not None:
        entries["rotation"][n] = tick.landmark_rotation[target]
    entries["covariance"][n, 3:, 3:] = tick.landmark_std[target] ** 2 * IDENTITY


def _put_report(entries: NDArray[Any], n: int, message: Message) -> None:
    """Write orientation and covariance of a target as far as they are reported."""
    R, P = message.rotation, message.covariance
    if R is not None:
        entries["rotation"][n] = R
    if P is None:
        return
    if len(P) == 6 and R is not None:
        entries["covariance"][n] = P
    else:
        entries["covariance"][n, 3:, 3:] = P[:3, :3] if R is None else R.T.dot(P).dot(R)


@lru_cache
def table_of_sensors(lever_arm: bytes, bearing_std: float, *sensors: Sensor) -> tuple[NDArray[Any], bool]:
    """Return the table (1 + s,) of a camera and other sensors, and whether all their kinds are compiled."""
    table = np.zeros(1 + len(sensors), SENSOR)
    table["rotation"] = np.eye(3)
    table[CAMERA]["kind"], table[CAMERA]["rows"] = BEARING, BEARING_ROWS
    table[CAMERA]["position"], table[CAMERA]["variance"] = np.frombuffer(lever_arm), bearing_std**2
    table[CAMERA]["angle"][:BEARING_ROWS] = 1
    for row, sensor in zip(table[1:], sensors, strict=True):
        rows = sensor.kind.rows
        row["kind"], row["rows"] = COMPILED.get(sensor.reference, OWN_KIND), rows
        row["position"], row["rotation"] = sensor.position, sensor.rotation
        row["variance"][:rows], row["variance_by_distance"] = np.square(sensor.std), sensor.std_by_distance**2
        row["angle"][:rows] = np.equal(sensor.kind.units, "rad") & (sensor.std < UNKNOWN_ANGLE)
    return table, OWN_KIND not in table["kind"]
