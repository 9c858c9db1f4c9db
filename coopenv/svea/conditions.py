"""What a car says of its camera and of its own condition."""

from typing import Any

import numpy as np

from coopenv.errors import CoopenvError, shown
from coopenv.svea.numbers import numbers_of
from coopenv.svea.remote import MOST_CHANNELS
from coopenv.svea.samples import Calibration, Status

LONGEST_MODE = 64  # characters


def calibration_of(message: Any) -> Calibration:
    """Return the intrinsics of a CameraInfo; ROS 1 writes their names large."""
    size = (int(message.width), int(message.height))
    if not all(0 < side <= 100_000 for side in size):
        raise CoopenvError(f"width, height: {size} is no image")
    if message.distortion_model not in ("plumb_bob", ""):
        raise CoopenvError(f"distortion_model: {shown(message.distortion_model)}, expected 'plumb_bob'")
    matrix = numbers_of(getattr(message, "k", getattr(message, "K", ())), "k", 1e6)
    given = numbers_of(getattr(message, "d", getattr(message, "D", ())), "d", 1e6)
    if matrix.shape != (9,) or min(matrix[0], matrix[4]) <= 0.0 or matrix[1] != 0.0:
        raise CoopenvError("k: no camera matrix with two positive focal lengths and no skew")
    if given.shape not in ((0,), (4,), (5,)):
        raise CoopenvError(f"d: {given.size} numbers, expected k1, k2, p1, p2, k3")
    k1, k2, p1, p2, k3 = (*map(float, given), *[0.0] * (5 - given.size))
    focal, centre = (float(matrix[0]), float(matrix[4])), (float(matrix[2]), float(matrix[5]))
    return Calibration(size, focal, centre, (k1, k2, p1, p2, k3))


def state_of(message: Any) -> Status:
    """Return whether a car's autopilot is armed and connected, and in which mode."""
    return Status(armed=bool(message.armed and message.connected), mode=str(message.mode)[:LONGEST_MODE])


def remote_of(message: Any) -> Status:
    """Return the pulses of a car's remote control; none with a signal strength of 0, and 255 says: not known."""
    return Status(pulses=tuple(int(pulse) for pulse in message.channels[:MOST_CHANNELS]) if message.rssi else ())


def battery_of(message: Any) -> Status:
    """Return the share that is left; NaN and -1 say: not known."""
    share = float(message.percentage)
    if np.isnan(share) or share == -1.0:
        return Status()
    if not 0.0 <= share <= 1.0:
        raise CoopenvError(f"percentage: {share:g} is not in 0..1")
    return Status(battery=share)
