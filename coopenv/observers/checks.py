"""Whether what an observer returns is an estimate or a message at all; every tick pays for it, so it is kept cheap."""

from functools import cache
from math import isfinite
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf

from coopenv.base.errors import CoopenvError, shown
from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.validity import MAX_BEND, MOST_LOPSIDED
from coopenv.observers.contract import Estimate, Message
from coopenv.scenario.base import LARGEST

MOST_NEGATIVE = 1e-9  # how far below zero an eigenvalue of P may lie, relative to the largest one

FARTHEST = 1e8  # m, of a plausible position: the earth is smaller
LEAST_VARIANCE, LARGEST_VARIANCE = 1e-16, 1e12  # rad^2 and m^2, of a plausible covariance

POSITION, ROTATION, COVARIANCE = (3,), (3, 3), (6, 6)
SENT_COVARIANCES = (ROTATION, COVARIANCE)  # shapes: of the marker's position, or of the whole pose
PRECISIONS = (np.dtype(np.float64), np.dtype(np.float32))


@cache
def compiled_checks() -> Any:
    """Return the compiled checks, with which Numba is loaded; whoever must not wait later calls this beforehand."""
    from coopenv.estimation import sound

    return sound


def check_estimate(estimate: Estimate) -> None:
    """Refuse what is no estimate, with a CoopenvError that names the field and what is wrong with it."""
    R, p, P, sound = estimate.rotation, estimate.position, estimate.covariance, compiled_checks()
    if not (sound.is_plain(R, 2) and sound.is_rotation(R)):
        _check_array("rotation", R, LARGEST, ROTATION)
        _check_rotation(np.asarray(R))
    if not (sound.is_plain(p, 1) and sound.is_position(p, LARGEST)):
        _check_array("position", p, LARGEST, POSITION)
    if not isinstance(estimate.coordinates, Coordinates):
        raise CoopenvError(f"coordinates are {shown(estimate.coordinates)}, not a member of Coordinates")
    if P is not None and not (sound.is_plain(P, 2) and P.shape == COVARIANCE and is_definite(P, 0.0, LARGEST**2)):
        _check_array("covariance", P, LARGEST**2, COVARIANCE)
        _check_covariance(np.asarray(P))
    if estimate.nis is not None and not (isfinite(estimate.nis) and index(estimate.nis_dof) >= 0):
        raise CoopenvError("nis is not finite, or nis_dof negative")


def check_message(message: Message) -> None:
    """Refuse what is no message; `extra` is the observer's own business, as long as it holds numbers."""
    if not _is_sound(message):
        _check_fields(message)
    for name, value in message.extra.items():
        if np.asarray(value).dtype.kind not in "biufc":
            raise CoopenvError(f"message: extra '{name}' is no array of numbers")


def check_received(message: Message, planar: bool = False) -> None:
    """Refuse what a receiver must not work with, with a CoopenvError: whoever sent it may be broken, or hostile.

    Besides what no message may be: a rotation that is none, a covariance that is not positive definite or of no
    plausible size, and anything that is not finite. Robots on a plane know their height: theirs may be semidefinite.
    """
    if not _is_sound(message):
        _check_fields(message)
        if message.position is not None and np.abs(message.position).max() > FARTHEST:
            raise CoopenvError(f"message: position beyond {FARTHEST:g} m")
        if message.rotation is not None:
            _check_rotation(np.asarray(message.rotation, np.float64))
        if message.covariance is not None:
            P = np.asarray(message.covariance, np.float64)
            _check_covariance(P)
            implausible = P.diagonal().max() > LARGEST_VARIANCE
            if implausible or not (planar or is_definite(P, LEAST_VARIANCE, LARGEST_VARIANCE)):
                raise CoopenvError("message: covariance is not positive definite, or not plausible")
    for name, value in message.extra.items():
        _check_extra(name, np.asarray(value))


def _check_fields(message: Message) -> None:
    """Refuse a pose or a covariance that is none."""
    if message.position is not None:
        _check_array("message: position", message.position, LARGEST, POSITION)
    if message.rotation is not None:
        _check_array("message: rotation", message.rotation, LARGEST, ROTATION)
    if message.covariance is not None:
        _check_array("message: covariance", message.covariance, LARGEST**2, *SENT_COVARIANCES)


def _is_sound(message: Message) -> bool:
    """Return whether pose and covariance are sound for certain; it does not look at `extra`."""
    sound, p, R, P = compiled_checks(), message.position, message.rotation, message.covariance
    if p is not None and not (sound.is_plain(p, 1) and sound.is_position(p, FARTHEST)):
        return False
    if R is not None and not (sound.is_plain(R, 2) and sound.is_rotation(R)):
        return False
    if P is None:
        return True
    plain = type(P) is np.ndarray and P.shape in SENT_COVARIANCES and P.dtype in PRECISIONS
    return plain and is_definite(P.astype(np.float64), LEAST_VARIANCE, LARGEST_VARIANCE)


def _check_extra(name: str, value: NDArray[Any]) -> None:
    """Refuse what is no array of finite numbers; a sum of squares tells it sooner, unless that is large."""
    kind = value.dtype.kind
    if kind not in "biufc":
        raise CoopenvError(f"message: extra '{name}' is no array of numbers")
    if kind in "fc" and not isfinite(abs(np.vdot(value, value))) and not np.isfinite(value).all():
        raise CoopenvError(f"message: extra '{name}' is not finite")


def is_definite(P: Array, least: float, largest: float) -> bool:
    """Return whether P (n, n) is a positive definite covariance, of variances from the least on, none larger."""
    return bool(compiled_checks().is_covariance(P, least, largest))


def _are_bounded(values: NDArray[Any], largest: float) -> bool:
    """Return whether numbers are finite and not too large; a sum of squares tells it sooner, unless that is large."""
    if values.dtype.kind == "f" and np.vdot(values, values) <= largest * largest:
        return True
    return bool((np.abs(values.astype(float)) <= largest).all())


def _check_array(name: str, value: ArrayLike, largest: float, *shapes: tuple[int, ...]) -> None:
    array = np.asarray(value)
    kind = array.dtype.kind
    if kind == "c":
        raise CoopenvError(f"{name} is complex")
    if array.shape not in shapes or kind not in "iuf" or not _are_bounded(array, largest):
        shape = " or ".join(map(str, shapes))
        raise CoopenvError(f"{name} is not a finite array of shape {shape} with numbers up to {largest:g}")


def _check_rotation(R: Array) -> None:
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # numbers of Python: faster than arrays this small
    off = (a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i)
    norms = (a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i)
    if max(map(abs, off)) > MAX_BEND or max(norms) > 1.0 + MAX_BEND or min(norms) < 1.0 - MAX_BEND:
        raise CoopenvError("rotation is not orthogonal")
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0:
        raise CoopenvError("rotation is a reflection")


def _check_covariance(P: Array) -> None:
    lopsided = P - P.T
    if np.vdot(lopsided, lopsided) > MOST_LOPSIDED**2 * np.vdot(P, P):
        raise CoopenvError("covariance is not symmetric")
    if dpotrf(P)[1] == 0 or dpotrf(P + MOST_NEGATIVE * P.diagonal().max() * np.eye(len(P)))[1] == 0:
        return  # the second one for those that are singular, as robots' on a plane are
    eigenvalues = np.linalg.eigvalsh(P)
    if eigenvalues[0] < -MOST_NEGATIVE * eigenvalues[-1]:
        raise CoopenvError("covariance is not positive semidefinite")
