"""Estimated poses with covariance, and their errors as numbers for plots."""

import json
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.messages import codec
from coopenv.base.format import jsonable
from coopenv.estimation.map_covariance import covariance_in_map
from coopenv.viz.foxglove.shown import MAP, Shown, short
from coopenv.viz.topview_geometry import SIGMAS

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ERROR = "coopenv.EstimateError"
_NUMBERS = {
    "position_error_m": "norm of the difference of true and estimated position, m",
    "orientation_error_deg": "angle between true and estimated orientation, deg",
    "three_sigma_m": "three times the largest standard deviation of the position that the observer states, m",
    "nees": "e^T P^-1 e; its mean is the number of states for an honest observer",
}
ERROR_SCHEMA = json.dumps(
    {
        "title": ERROR,
        "type": "object",
        "properties": {name: {"type": ["number", "null"], "description": about} for name, about in _NUMBERS.items()},
    }
).encode()


def poses(shown: Shown, vehicle: int) -> Iterator[tuple[int, bytes]]:
    """Yield a vehicle's estimate; a covariance of zeros, as ROS has it, where the observer states none."""
    store, run = codec(), shown.run
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "geometry_msgs" in name}
    time, header = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    R, p = run.rotation[:, vehicle], run.position[:, vehicle]
    covariance = covariance_in_map(run.coordinates, R, p, run.covariance[:, vehicle])
    for k in shown.ticks:
        if not (np.isfinite(R[k]).all() and np.isfinite(p[k]).all()):
            continue
        stated = not shown.gain and bool(np.isfinite(covariance[k]).all())
        P = np.array(short(covariance[k])).ravel() if stated else np.zeros(36)
        q = short(Rotation.from_matrix(R[k]).as_quat())
        place = types["Pose"](types["Point"](*short(p[k])), types["Quaternion"](*q))
        stamp = time(*divmod(shown.clock.nanoseconds(k), 10**9))
        message = types["PoseWithCovarianceStamped"](header(stamp, MAP), types["PoseWithCovariance"](place, P))
        yield k, bytes(store.serialize_cdr(message, POSE))


def errors(shown: Shown, vehicle: int) -> Iterator[tuple[int, bytes]]:
    """Yield a vehicle's errors as JSON; what is not known is null."""
    run = shown.run
    P = covariance_in_map(
        run.coordinates, run.rotation[:, vehicle], run.position[:, vehicle], run.covariance[:, vehicle]
    )[:, :3, :3]
    stated = np.asarray(np.isfinite(P).all(axis=(1, 2)) & (not shown.gain))
    largest = np.linalg.eigvalsh(np.where(stated[:, None, None], P, 0.0))[:, -1]
    sigma = np.where(stated, SIGMAS * np.sqrt(np.maximum(largest, 0.0)), np.nan)
    nees = np.where(stated, run.nees[:, vehicle], np.nan)
    columns = (run.position_error[:, vehicle], run.orientation_error[:, vehicle], sigma, nees)
    for k in shown.ticks:
        row = {name: float(f"{column[k]:.6g}") for name, column in zip(_NUMBERS, columns, strict=True)}
        yield k, json.dumps(jsonable(row), separators=(",", ":")).encode()
