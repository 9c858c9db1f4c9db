"""Measurements of any kind, linearised at a pose by compiled functions.

Each kind has rows. A row depends on the place of the target in the body frame by a vector j: its derivative is (j x a,
-j) by a left error, with a the point about which the body turns it, and g = R j by the target in map axes. A row may
also depend on turns. What was not measured, or needs what is not known of a target, has residual 0, derivative 0 and
noise 1, and so counts nothing.

A kind of a user has functions in NumPy, which compiled functions call.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import objmode, types
from numpy.typing import NDArray

from coopenv.estimation.compiled import (
    FLAG,
    MATRICES,
    MATRIX,
    NUMBER,
    ROW,
    TARGET,
    VECTOR,
    WHOLE,
    adjoint,
    compiled,
    congruent,
    eliminated,
    exp_so3,
    logarithm,
    place,
    product,
    transformed,
)
from coopenv.estimation.poses import Array
from coopenv.measurements.kinds import Placed
from coopenv.observers.frame import (
    ATTITUDE,
    BEARING,
    FRAME,
    OWN_KIND,
    POSITION,
    RANGE,
    RELATIVE_POSE,
    Frame,
    UsableMeasurements,
    ticks_of_own_kinds,
)
from coopenv.observers.uncertain_pose import RIGHT, UncertainPose

BLOCKS = types.Array(types.float64, 3, "C")
FLAGS, FLAG_ROWS = (types.Array(types.boolean, n, "A", readonly=True) for n in (1, 2))


class LinearMeasurements(NamedTuple):
    """Linearised measurements, m of them, each with r rows, of which some were measured."""

    residual: Array  # (m, r); of bearings rad, in the tangent planes
    H: Array  # (m, r, n) derivative of the measurement by the error
    N: Array  # (m, r, r) covariance of the residuals given the own pose
    by_target: Array  # (m, r, 6) derivative by turn and shift of the target in the axes of its covariance
    variance: Array  # (m, r) of the sensors alone
    used: NDArray[np.bool_]  # (m, r) rows that were measured
    angle: NDArray[np.bool_]  # (m, r) rows among them that measure an angle
    ahead: NDArray[np.bool_]  # (m,) whether the points are ahead along the bearings, and not behind
    measured: UsableMeasurements

    def only(self, kept: NDArray[np.bool_]) -> "LinearMeasurements":
        """Return the measurements of a mask (m,)."""
        arrays: tuple[NDArray[Any], ...] = self[:-1]
        return LinearMeasurements._make([*(array[kept] for array in arrays), self.measured.only(kept)])

    def stacked(self) -> tuple[Array, Array, Array]:
        """Return residual (k,), H (k, n) and N (k, k) of the rows that were measured."""
        residual, H, N = stacked(self.residual, self.H, self.N, self.by_target, self.used, self.measured.frame)
        return residual, H, N


def linearised(pose: UncertainPose, measured: UsableMeasurements) -> LinearMeasurements:
    """Linearise measurements at a pose; the points' covariances are noise, as if independent of the pose."""
    return LinearMeasurements(*linearise(pose.R, pose.p, pose.kind == RIGHT, measured.frame), measured)


@compiled(NUMBER, NUMBER, NUMBER)
def across(x: float, y: float, z: float) -> Array:
    """Return (2, 3) orthonormal rows across a unit vector.

    Source: Duff et al., Building an orthonormal basis, revisited, Journal of Computer Graphics Techniques 6(1), 2017.
    """
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    c = x * y * a
    return np.array([[1.0 + sign * x * x * a, sign * c, -sign * x], [c, sign + y * y * a, -y]])


@compiled(ROW, VECTOR, VECTOR, NUMBER)
def put_derivative(row: Array, u: Array, about: Array, factor: float) -> None:
    """Write (u x about, -u) times a factor into a row (6,)."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        row[k] = (u[i] * about[j] - u[j] * about[i]) * factor
        row[k + 3] = -u[k] * factor


@compiled(WHOLE, VECTOR, VECTOR, MATRIX, ROW, TARGET)
def put_sight(kind: int, value: Array, d: Array, M: Array, residual: Array, J: Array) -> bool:
    """Write the rows of direction and distance of a target at d (3,); return whether it is ahead along the value.

    Args:
        kind: BEARING, RANGE or RANGE_BEARING.
        value: as measured.
        d: from the sensor to the target, the sensor's axes, m.
        M: (3, 3) sensor to body.
        residual: (r,) its rows.
        J: (r, 3) derivatives by the place of the target in the body frame.
    """
    distance, row = max(math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9), 0
    if kind != RANGE:
        B = across(d[0] / distance, d[1] / distance, d[2] / distance)
        for k in range(2):
            residual[k] = B[k, 0] * value[0] + B[k, 1] * value[1] + B[k, 2] * value[2]
            for i in range(3):
                J[k, i] = (M[i, 0] * B[k, 0] + M[i, 1] * B[k, 1] + M[i, 2] * B[k, 2]) / distance
        row = 2
    if kind != BEARING:
        residual[row] = value[0 if kind == RANGE else 3] - distance
        for i in range(3):
            J[row, i] = (M[i, 0] * d[0] + M[i, 1] * d[1] + M[i, 2] * d[2]) / distance
    return kind == RANGE or d[0] * value[0] + d[1] * value[1] + d[2] * value[2] > 0.0


@compiled(VECTOR, MATRIX, ROW)
def put_turn(value: Array, predicted: Array, residual: Array) -> None:
    """Write the turn (3,), rad, from a predicted orientation (3, 3) to a measured rotation vector."""
    turn = logarithm(product(exp_so3(value), predicted.T))
    for k in range(3):
        residual[k] = turn[k]


@compiled(WHOLE, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, ROW, TARGET, TARGET, TARGET)
def put_rows(
    kind: int,
    value: Array,
    z: Array,
    d: Array,
    R: Array,
    M: Array,
    target_R: Array,
    residual: Array,
    J: Array,
    H: Array,
    by_target: Array,
) -> bool:
    """Write the rows of one measurement; return whether its target is ahead of the sensor.

    Args:
        kind: a compiled one.
        value: as measured.
        z: place of the target, or of a sensor that measures the map, in map axes, m.
        d: from the sensor to the target, the sensor's axes, m.
        R: (3, 3) body to map.
        M: (3, 3) sensor to body.
        target_R: (3, 3) target to map.
        residual: (r,) its rows.
        J: (r, 3) derivatives by the place z in body axes.
        H: (r, 6), first the derivatives by a turn of the body that changes neither z nor the place of the sensor.
        by_target: (r, 6), first the derivatives by a turn of the target about its axes.
    """
    if kind == POSITION:
        for k in range(3):
            residual[k] = value[k] - z[k]
            for i in range(3):
                J[k, i] = -R[k, i]
    elif kind == ATTITUDE:
        put_turn(value[:3], product(R, M), residual[:3])
        place(H, 0, 0, R)
    elif kind == RELATIVE_POSE:
        for k in range(3):
            residual[k] = value[k] - d[k]
        turned = product(product(R, M).T, target_R)
        put_turn(value[3:], turned, residual[3:])
        place(J, 0, 0, M.T)
        place(H, 3, 0, -M.T)
        place(by_target, 3, 0, turned)
    else:
        return put_sight(kind, value, d, M, residual, J)
    return True


@compiled(FLAG, MATRIX, VECTOR, VECTOR, VECTOR, ROW)
def add_place(right: bool, R: Array, j: Array, a: Array, z: Array, row: Array) -> None:
    """Add the derivative by the place of a target to a row (6,) that has one by a turn of the body.

    Args:
        right: whether the error is about the map's axes.
        R: (3, 3) body to map.
        j: (3,) derivative by the place in body axes.
        a: (3,) the place in the body frame, m.
        z: (3,) on the map, m.
        row: (6,) is changed.
    """
    x, y, w = row[0], row[1], row[2]
    if right:
        put_derivative(row, transformed(R, j), z, 1.0)
        for i in range(3):
            row[i] += R[i, 0] * x + R[i, 1] * y + R[i, 2] * w
    else:
        put_derivative(row, j, a, 1.0)
        row[0], row[1], row[2] = row[0] + x, row[1] + y, row[2] + w


@compiled(TARGET, BLOCKS, BLOCKS, TARGET, types.Array(types.boolean, 2, "C"), FRAME)
def completed(
    residual: Array, H: Array, by_target: Array, variance: Array, used: NDArray[np.bool_], frame: Frame
) -> tuple[Array, NDArray[np.bool_]]:
    """Clear rows that are not finite, and return N and `angle` of `LinearMeasurements`."""
    entries, sensors, weight, _ = frame
    (m, r), angle = residual.shape, np.zeros(residual.shape, np.bool_)
    N = np.zeros((m, r, r))
    for n in range(m):
        for k in range(r):
            total = residual[n, k]
            for i in range(6):
                total += H[n, k, i] + by_target[n, k, i]
            if not math.isfinite(total):
                residual[n, k], variance[n, k], used[n, k] = 0.0, 1.0, False
                for i in range(6):
                    H[n, k, i] = by_target[n, k, i] = 0.0
            angle[n, k] = used[n, k] and sensors.angle[entries.sensor[n], k] == 1
        if weight > 0.0 and np.trace(entries.covariance[n]) > 0.0:
            place(N[n], 0, 0, weight * congruent(by_target[n], entries.covariance[n]))
        for k in range(r):
            N[n, k, k] += variance[n, k]
    return N, angle


@compiled(MATRIX, VECTOR, FLAG, FRAME, TARGET, BLOCKS, BLOCKS, TARGET, types.Array(types.boolean, 2, "C"))
def call_own_kinds(
    R: Array, p: Array, right: bool, frame: Any, residual: Array, H: Array, by_target: Array, variance: Array, used: Any
) -> None:
    """Call `put_own_kinds`.

    Numba keeps a function that calls Python together with all compiled functions that it names, and compiles these
    again in every process: so this one names none.
    """
    with objmode():
        put_own_kinds(R, p, right, frame, residual, H, by_target, variance, used)


@compiled(MATRIX, VECTOR, FLAG, FRAME)
def linearise(
    R: Array, p: Array, right: bool, frame: Frame
) -> tuple[Array, Array, Array, Array, Array, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the first fields of `LinearMeasurements`; `right`: the error is about the map's axes."""
    entries, sensors, _, own = frame
    m, r = len(entries), np.max(sensors.rows)
    residual, H, by_target, variance = np.zeros((m, r)), np.zeros((m, r, 6)), np.zeros((m, r, 6)), np.ones((m, r))
    J, used, ahead = np.zeros((m, r, 3)), np.zeros((m, r), np.bool_), np.ones(m, np.bool_)
    for n in range(m):
        s, target = entries.sensor[n], entries.target[n]
        kind, lever_arm, M = sensors.kind[s], sensors.position[s], sensors.rotation[s]
        if kind == OWN_KIND:
            continue
        z, axes = entries.position[n] if target >= 0 else p + transformed(R, lever_arm), R
        a = transformed(R.T, z - p)
        d = transformed(M.T, a - lever_arm)
        its_R = entries.rotation[n]
        ahead[n] = put_rows(kind, entries.value[n], z, d, R, M, its_R, residual[n], J[n], H[n], by_target[n])
        if its_R[0, 0] ** 2 + its_R[1, 0] ** 2 + its_R[2, 0] ** 2 > 0.0:
            axes = product(its_R.T, R)
        by_distance = sensors.variance_by_distance[s] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        for k in range(sensors.rows[s]):
            add_place(right, R, J[n, k], a, z, H[n, k])
            variance[n, k], used[n, k] = sensors.variance[s, k] + by_distance + entries.curvature[n, k], True
            for i in range(3 if target >= 0 else 0):
                by_target[n, k, i + 3] = axes[i, 0] * J[n, k, 0] + axes[i, 1] * J[n, k, 1] + axes[i, 2] * J[n, k, 2]
    if own != 0:
        call_own_kinds(R, p, right, frame, residual, H, by_target, variance, used)
    N, angle = completed(residual, H, by_target, variance, used, frame)
    return residual, H, N, by_target, variance, used, angle, ahead


def put_own_kinds(
    R: Array, p: Array, right: bool, frame: Any, residual: Array, H: Array, by_target: Array, variance: Array, used: Any
) -> None:
    """Write the measurements of kinds that are not compiled; arguments as for `LinearMeasurements`."""
    entries, sensors, _, own = frame
    to_error = np.linalg.inv(adjoint(R, p)) if right else np.eye(6)
    tick = ticks_of_own_kinds[own]
    for number in np.flatnonzero(sensors["kind"] == OWN_KIND):
        sensor = tick.readings[number - 1].sensor
        of = np.flatnonzero(entries["sensor"] == number)
        if not len(of):
            continue
        its = entries[of]
        place_of_own = sensor.placed(R, p, tick.velocity, tick.angular_velocity, tick.landmarks_by_name)
        target = Placed(its["position"], its["rotation"], its["velocity"], np.zeros_like(its["velocity"]))
        found = sensor.linearised(R, place_of_own.repeated(len(of)), target, its["value"][:, : sensor.kind.size])
        rows = slice(0, sensor.kind.rows)
        residual[of, rows], used[of, rows] = found.residual, found.used
        variance[of, rows] = found.noise + its["curvature"][:, rows]
        H[of, rows], by_target[of, rows] = found.by_own @ to_error, found.by_target
        known = np.isfinite(its["rotation"]).all(axis=(1, 2))
        by_target[of[known], rows, 3:] = found.by_target[known, :, 3:] @ its["rotation"][known]


@compiled(TARGET, WHOLE, WHOLE, MATRIX, FLAGS, FLAGS)
def put_used(
    M: Array, row: int, column: int, block: Array, rows: NDArray[np.bool_], columns: NDArray[np.bool_]
) -> None:
    """Write the marked rows and columns of a block into a matrix."""
    for i in range(len(rows)):
        if rows[i]:
            at = column
            for j in range(len(columns)):
                if columns[j]:
                    M[row, at] = block[i, j]
                    at += 1
            row += 1


@compiled(MATRIX, MATRICES, MATRICES, MATRICES, FLAG_ROWS, FRAME)
def stacked(
    residual: Array, H: Array, N: Array, by_target: Array, used: NDArray[np.bool_], frame: Frame
) -> tuple[Array, Array, Array]:
    """Return residual (k,), H (k, n) and N (k, k) of the rows that were measured, with H (m, r, n).

    Two measurements of one uncertain target have correlated residuals.
    """
    (m, r, width), k, row = H.shape, np.count_nonzero(used), 0
    stacked_residual, stacked_H, stacked_N = np.empty(k), np.empty((k, width)), np.zeros((k, k))
    first = np.zeros(m + 1, np.int64)
    for n in range(m):
        for i in range(r):
            if used[n, i]:
                stacked_residual[row] = residual[n, i]
                for j in range(width):
                    stacked_H[row, j] = H[n, i, j]
                row += 1
        first[n + 1] = row
        put_used(stacked_N, first[n], first[n], N[n], used[n], used[n])
    entries, _, weight, _ = frame
    for n in range(m if weight > 0.0 else 0):
        C, target = entries.covariance[n], entries.target[n]
        for l in range(n):  # noqa: E741
            if entries.target[l] == target and target >= 0 and np.trace(C) > 0.0:
                both = weight * product(product(by_target[n], C), by_target[l].T)
                put_used(stacked_N, first[n], first[l], both, used[n], used[l])
                put_used(stacked_N, first[l], first[n], both.T, used[l], used[n])
    return stacked_residual, stacked_H, stacked_N


@compiled(MATRIX, MATRICES)
def normalised(residual: Array, S: Array) -> Array:
    """Return (m,) r^T S^-1 r of residuals (m, r)."""
    result = np.zeros(len(residual))
    for n in range(len(residual)):
        if residual.shape[1] == 2:
            x, y = residual[n]
            a, b, d = S[n, 0, 0], S[n, 0, 1], S[n, 1, 1]
            result[n] = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
        else:
            solved = eliminated(S[n], residual[n].copy().reshape(-1, 1))
            for k in range(residual.shape[1]):
                result[n] += residual[n, k] * solved[k, 0]
    return result


@compiled(MATRICES)
def dense(blocks: Array) -> Array:
    """Return (rm, rm) the block diagonal of blocks (m, r, r)."""
    r = blocks.shape[1]
    N = np.zeros((r * len(blocks), r * len(blocks)))
    for n in range(len(blocks)):
        place(N, r * n, r * n, blocks[n])
    return N


@compiled(MATRICES, MATRIX, MATRICES)
def spread(H: Array, P: Array, N: Array) -> Array:
    """Return (m, r, r) H P H^T + N of every measurement."""
    S, r = N.copy(), N.shape[1]
    for n in range(len(H)):
        HPH = congruent(H[n], P)
        for i in range(r):
            for j in range(r):
                S[n, i, j] += HPH[i, j]
    return S
