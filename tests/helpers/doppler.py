"""A user's own sensors, as the page about sensors describes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from coopenv.measurements.in_warp import excess, first_row, plus_noise, rows_of
from coopenv.measurements.kinds import Placed, WarpFunctions


class Doppler:
    """The speed at which the distance to a target grows, m/s."""

    noise = 0.05
    units = ("m/s",)

    def predict(self, own: Placed, target: Placed) -> np.ndarray:
        line = target.position - own.position
        return line @ (target.velocity - own.velocity) / np.linalg.norm(line)


@wp.func
def predict_doppler(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any, empty: Any):
    """Return the speed at which the distance grows, m/s."""
    o = empty.dtype(0.0)
    return type(empty)(wp.dot(wp.normalize(target_p - p), target_v - v), o, o, o, o, o)


@wp.func
def derive_doppler(R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any):
    """Return the derivatives by the sensor and by the target; a turn turns the velocity with it."""
    line = target_p - p
    u = wp.normalize(line)
    moving = target_v - v
    across = (moving - wp.dot(u, moving) * u) / wp.length(line)
    turn = wp.transpose(R) * wp.cross(u, v)
    target_turn = wp.transpose(target_R) * wp.cross(target_v, u)
    return rows_of(first_row(turn), first_row(-across)), rows_of(first_row(target_turn), first_row(across))


class DopplerInWarp(Doppler):
    """The same sensor with functions for kernels."""

    in_warp = WarpFunctions(predict_doppler, plus_noise, excess, derive_doppler)


class DopplerOfWorlds(Doppler):
    """The same sensor without what an observer in kernels needs."""

    in_warp = WarpFunctions(predict_doppler, plus_noise)


class NearDoppler(Doppler):
    """A Doppler sensor of a reach of its own, m."""

    def __init__(self, reach: float) -> None:
        self.reach = reach

    def sensed(self, own: Placed, target: Placed) -> bool:
        return bool(np.linalg.norm(target.position - own.position) < self.reach)


class Raising(Doppler):
    """A sensor whose prediction fails behind itself."""

    def predict(self, own: Placed, target: Placed) -> np.ndarray:
        if target.position[0] > 100.0:
            raise RuntimeError("out of order")
        return super().predict(own, target)


class Unknown(Doppler):
    """A sensor whose prediction is not finite far away."""

    def predict(self, own: Placed, target: Placed) -> np.ndarray:
        return super().predict(own, target) if target.position[0] <= 100.0 else np.array([np.nan])
