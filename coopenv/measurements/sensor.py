"""A sensor of a vehicle: a kind of measurement with a mounting, noise and targets; its measurements of one tick."""

import json
import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import check_one_of
from coopenv.base.installation import is_reference
from coopenv.estimation.poses import Array, skew
from coopenv.measurements.kinds import Kind, Landmarks, Placed, WarpFunctions
from coopenv.measurements.named import allow
from coopenv.measurements.table import KINDS

NOTHING = Landmarks()
MAP = -1
"""Target of a kind that measures the map."""
COMPARED_AT = 10.0
"""Distance (m) of a target whose bearing a measurement of the map is compared with in the Gramian."""


def kind_of(reference: str, options: str = "{}") -> Kind:
    """Return a kind by name, or a user's class by `file.py:Class` with arguments in JSON.

    Raises:
        CoopenvError: there is no such kind, or the class is not as it should be.
    """
    if is_reference(reference):
        from coopenv.measurements.own import OwnKind  # which most programs do not need

        allow(reference)
        return OwnKind(reference, json.loads(options))
    return _shipped(reference)


@cache
def _shipped(name: str) -> Kind:
    check_one_of("unknown kind of sensor", name, KINDS)
    module, _, kind = KINDS[name].partition(":")
    made: Kind = getattr(import_module(f"{__package__}.{module}"), kind)()
    return made


_of_users: list[WarpFunctions] = []


def number_of(reference: str, kind: Kind) -> int:
    """Return the number of a kind in kernels: users' kinds follow on the table; -1: without Warp functions.

    Raises:
        CoopenvError: a Warp function of a user's kind does not do what the class does in NumPy.
    """
    if reference in KINDS:
        return [*KINDS].index(reference)
    if kind.in_warp is None:
        return -1
    if kind.in_warp not in _of_users:
        from coopenv.measurements.own_in_warp import check_in_warp  # which most programs do not need

        check_in_warp(kind)
        _of_users.append(kind.in_warp)
    return len(KINDS) + _of_users.index(kind.in_warp)


def functions_of(number: int) -> WarpFunctions:
    """Return the Warp functions of the kind of a number."""
    functions = _shipped([*KINDS][number]).in_warp if number < len(KINDS) else _of_users[number - len(KINDS)]
    assert functions is not None
    return functions


CURVATURE_TIME = 12.0
"""Time, s, in which all frames have the same second-order error. Tuned by `benchmarks.kinds` with ranges alone: with 0,
2, 12 and 30 s ANEES of `schmidt_kalman` is 2.0, 1.4, 1.0 and 0.8, and RMSE over the bound 1.3, 1.1, 1.1 and 1.1."""


def averaged_std(white: Array, correlated: Array, time: float, period: float) -> Array:
    """Return standard deviations (rows,) of white noise that averages as noise with a correlated part does.

    A Gauss-Markov error of correlation time T, sampled every `period` s with r = exp(-period / T), counts in a long
    mean as white noise of (1 + r) / (1 - r) times its variance.
    """
    r = math.exp(-period / time)
    return np.sqrt(np.square(white) + correlated**2 * (1.0 + r) / (1.0 - r))


class LinearRows(NamedTuple):
    """Linearised measurements of one sensor, m of them; what cannot be used has zero derivatives and unit noise."""

    residual: Array  # (m, rows)
    by_own: Array  # (m, rows, 6) by the left error of the own pose: turn and shift, both in body axes, rad and m
    by_target: Array  # (m, rows, 6) by a turn of the target about its own axes, rad, and its shift in map axes, m
    noise: Array  # (m, rows) variances
    used: NDArray[np.bool_]  # (m, rows)


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor of one vehicle, as the vehicle knows it."""

    name: str
    reference: str  # of its kind, see `kind_of`
    std: Array  # (rows,) of its noise as a filter counts it, in the units of the rows
    targets: NDArray[np.int64]  # (m,) which it may measure: indices of targets, or `MAP` alone
    position: Array  # (3,) in the body frame, m
    rotation: Array  # (3, 3) sensor to body
    options: str = "{}"  # arguments of a user's class, JSON
    std_by_distance: float = 0.0  # of the noise beside `std`, per m to the target
    bias: tuple[float, ...] = ()  # (rows,) standard deviations of constant errors, in the units of the rows, or empty
    scale: float = 0.0  # standard deviation of a constant relative error of its first row

    @cached_property
    def kind(self) -> Kind:
        """Kind of measurement, looked up once."""
        return kept_kind(self.reference, self.options)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields: another process looks the kind up again."""
        return {name: value for name, value in vars(self).items() if name != "kind"}

    def placed(self, R: Array, p: Array, velocity: Array, angular_velocity: Array, landmarks: Any = NOTHING) -> Placed:
        """Return where it is on a body at R (..., 3, 3), p (..., 3) with a twist (..., 3) in body axes."""
        turned = R @ self.rotation
        at_sensor = velocity + np.cross(angular_velocity, self.position)
        return Placed(
            p + (R @ self.position[:, None])[..., 0] if R.ndim > 2 else p + R @ self.position,
            turned,
            np.asarray((R @ at_sensor[..., None])[..., 0]),
            angular_velocity @ self.rotation,
            landmarks,
        )

    def linearised(self, R: Array, own: Placed, target: Placed, values: Array) -> LinearRows:
        """Linearise values (..., size) of targets; `own` is where the sensor is on a body of orientation R."""
        kind = self.kind
        residual = kind.residual(values, kind.predict(own, target))
        by_sensor, by_target = kind.jacobian(own, target)
        by_turn, by_shift = by_sensor[..., :3], by_sensor[..., 3:]
        arm = R @ skew(self.position)
        by_own = np.concatenate([by_turn @ self.rotation.T - by_shift @ arm, by_shift @ R], axis=-1)
        used = np.isfinite(residual) & np.isfinite(by_own).all(axis=-1)
        used &= np.isfinite(by_target).all(axis=-1)
        variances = np.broadcast_to(np.square(self.std), residual.shape)
        if self.std_by_distance:
            square = np.sum((target.position - own.position) ** 2, axis=-1)
            variances = variances + self.std_by_distance**2 * square[..., None]
        return LinearRows(
            np.where(used, residual, 0.0),
            np.where(used[..., None], by_own, 0.0),
            np.where(used[..., None], by_target, 0.0),
            np.where(used, variances, 1.0),
            used,
        )


def kept_kind(reference: str, options: str) -> Kind:
    """Return `kind_of`, made once, and again after the file of a user's class has changed."""
    file = Path(reference.rpartition(":")[0])
    changed = file.stat().st_mtime_ns if file.suffix == ".py" and file.exists() else 0
    return _kept(reference, options, changed)


@cache
def _kept(reference: str, options: str, changed: int) -> Kind:
    return kind_of(reference, options)


class Reading(NamedTuple):
    """Measurements of one sensor at a tick."""

    sensor: Sensor
    values: Array  # (m, size) in the order of the sensor's targets, NaN where nothing was measured
    age: float = 0.0  # s since it was measured

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(m,) whether a target was measured."""
        return np.asarray(np.isfinite(self.values).all(axis=-1))


def landmark_place(position: Array, rotation: Array) -> Placed:
    """Return landmarks at (..., 3) with orientations (..., 3, 3); of one that moves, that and the twist are NaN."""
    still = np.where(np.isfinite(rotation).all(axis=-1), 0.0, np.nan)
    return replace(Placed.at(position, rotation), velocity=still, angular_velocity=still)
