"""Measurements of a frame linearised at the current estimates, and their innovations."""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import skew
from coopenv.measurements.bearing import axes_across
from coopenv.observers.robust.algebra import Pose, by_rows, mat26d, vec3d
from coopenv.observers.robust.measurements import linearisation_variance
from coopenv.observers.robust.memory import (
    DERIVATIVES,
    FOCAL_ERROR,
    LANDMARK_SLOTS,
    LATENCY_ERROR,
    SENDER_SLOTS,
    BearingFrame,
    Derivative,
)
from coopenv.observers.robust.readings import linearise_reading
from coopenv.world.warp_internals import device_function, subroutine


@wp.func
def tangent_basis(b: Any):
    """Return two orthonormal rows (2, 3) across a unit vector."""
    first, second = axes_across(b)
    return wp.matrix_from_rows(first, second)


@device_function
def approach(memory: Any, world: int, i: int, member: int, turn: Any, point: Any, a: Any):
    """Return the velocity (m/s, body) at which a target at `a` (m, body) approaches.

    The twist is the mean of a second: noise of a sample would make the latency observable, see `errors_transition`.
    """
    velocity = memory.belief[world, i].mean_v + wp.cross(memory.belief[world, i].mean_w, a)
    if member > 0:
        moving = memory.member[world, i, member].v + wp.cross(memory.member[world, i, member].w, point)
        velocity = velocity - turn * moving
    return velocity


@subroutine
def linearise(frame: BearingFrame, memory: Any, world: int, i: int, n: int):
    """Linearise the n-th bearing, residual = H x + noise; return whether its target is ahead of the camera."""
    if memory.measurement[world, i, n].is_reading == 1:
        return linearise_reading(memory, world, i, n)
    member = memory.measurement[world, i, n].member
    point = memory.measurement[world, i, n].point
    bearing = memory.measurement[world, i, n].bearing
    own = memory.member[world, i, 0].pose
    z = point
    turn = wp.identity(3, wp.float64)
    if member > 0:
        theirs = memory.member[world, i, member].pose
        z = theirs.p + theirs.R * point
        turn = wp.transpose(own.R) * theirs.R
    a = wp.transpose(own.R) * (z - own.p)
    back = wp.transpose(frame.since.R)
    d = back * (a - frame.since.p) - frame.lever
    mounting = Pose(wp.identity(3, wp.float64), vec3d())
    if frame.mounting > 0:
        mounting = memory.member[world, i, frame.mounting].pose
        d = d - mounting.p
    distance = wp.max(wp.length(d), wp.float64(1.0e-9))
    inverse = wp.float64(1.0) / distance
    u = d * inverse
    # A relative error of the focal length moves bearings so; of the predicted one, because noise of the measured one
    # would be in innovation and derivative alike.
    predicted = wp.transpose(mounting.R) * u
    cosine = wp.dot(frame.axis, predicted)
    away = cosine * (cosine * predicted - frame.axis)
    if frame.errors > 0:
        bearing = wp.normalize(bearing - memory.member[world, i, frame.errors].v[1] * away)
    bearing = mounting.R * bearing
    T = tangent_basis(u)
    at_exposure = T * inverse
    B = at_exposure * back
    H = mat26d()
    H[:, :3] = B * skew(a)
    H[:, 3:] = -B
    memory.measurement[world, i, n].by_map = B * wp.transpose(own.R)
    memory.derivative[world, i, n, 0] = Derivative(0, H)
    memory.derivative[world, i, n, 1].member = wp.where(member > 0, member, -1)
    if member > 0:
        G = B * turn
        H[:, :3] = -(G * skew(point))
        H[:, 3:] = G
        memory.derivative[world, i, n, 1].jacobian = H
    memory.derivative[world, i, n, 2].member = wp.where(frame.mounting > 0, frame.mounting, -1)
    H[:, :3] = T * mounting.R * skew(memory.measurement[world, i, n].bearing)
    H[:, 3:] = -(at_exposure * mounting.R)
    memory.derivative[world, i, n, 2].jacobian = H
    by_age = B * approach(memory, world, i, member, turn, point, a)
    memory.derivative[world, i, n, 3].member = wp.where(frame.errors > 0, frame.errors, -1)
    H = mat26d()
    H[:, FOCAL_ERROR] = T * (mounting.R * away)
    H[:, LATENCY_ERROR] = by_age
    memory.derivative[world, i, n, 3].jacobian = H
    memory.measurement[world, i, n].residual = T * bearing
    memory.measurement[world, i, n].distance = distance
    remainder = linearisation_variance(memory, world, i, n, turn, u, distance, frame.period)
    variance = frame.variance + memory.measurement[world, i, n].variance * inverse * inverse + remainder
    variance += frame.jitter * wp.length_sq(by_age)
    memory.measurement[world, i, n].noise = variance
    return wp.dot(u, bearing) > wp.float64(0.0)


@device_function
def project(memory: Any, world: int, i: int, n: int):
    """Set a measurement's `projection` to H P; a loop over the derivatives would be slower."""
    H = memory.derivative[world, i, n, 0].jacobian
    member = memory.derivative[world, i, n, 1].member
    mounting = memory.derivative[world, i, n, 2].member
    errors = memory.derivative[world, i, n, 3].member
    for k in range(memory.belief[world, i].members):
        rows = by_rows(H, memory.P[world, i, 0, k])
        if member > 0:
            rows = rows + by_rows(memory.derivative[world, i, n, 1].jacobian, memory.P[world, i, member, k])
        if mounting > 0:
            rows = rows + by_rows(memory.derivative[world, i, n, 2].jacobian, memory.P[world, i, mounting, k])
        if errors > 0:
            rows = rows + by_rows(memory.derivative[world, i, n, 3].jacobian, memory.P[world, i, errors, k])
        memory.projection[world, i, n, k] = rows
    if memory.belief[world, i].map_errors == 1:
        project_on_map(memory, world, i, n)


@subroutine
def project_on_map(memory: Any, world: int, i: int, n: int):
    """Set a measurement's `map_projection`, and add the landmark's error on the map to its `projection`.

    That error f is considered: its covariance with the estimated errors is their sensitivity to f, which integrity.py
    carries on, times the variance of f.
    Source: Schmidt, Application of state-space methods to navigation problems, Advances in Control Systems 3, 1966.
    """
    source = memory.measurement[world, i, n].source
    mounting = memory.derivative[world, i, n, 2].member
    errors = memory.derivative[world, i, n, 3].member
    for slot in range(LANDMARK_SLOTS):
        q = 1 + SENDER_SLOTS + slot
        M = memory.derivative[world, i, n, 0].jacobian * memory.sensitivity[world, i, q, 0]
        if mounting > 0:
            M = M + memory.derivative[world, i, n, 2].jacobian * memory.sensitivity[world, i, q, mounting]
        if errors > 0:
            M = M + memory.derivative[world, i, n, 3].jacobian * memory.sensitivity[world, i, q, errors]
        variance = memory.source[world, i, q].map_variance
        if source == q:
            M = M + memory.measurement[world, i, n].by_map
            weighted = variance * memory.measurement[world, i, n].by_map
            for k in range(memory.belief[world, i].first_sender):
                rows = weighted * wp.transpose(memory.sensitivity[world, i, q, k])
                memory.projection[world, i, n, k] = memory.projection[world, i, n, k] + rows
        memory.map_projection[world, i, n, slot] = variance * M


@device_function
def innovation_cross_covariance(memory: Any, world: int, i: int, n: int, m: int):
    """Return the covariance, 2x2, of the n-th predicted bearing with the m-th innovation, given the earlier ones."""
    S = memory.derivative[world, i, n, 0].jacobian * wp.transpose(memory.projection[world, i, m, 0])
    for part in range(1, DERIVATIVES):
        k = memory.derivative[world, i, n, part].member
        if k > 0:
            S = S + memory.derivative[world, i, n, part].jacobian * wp.transpose(memory.projection[world, i, m, k])
    if memory.belief[world, i].map_errors == 1:
        slot = memory.measurement[world, i, n].source - 1 - SENDER_SLOTS
        if slot >= 0:
            S = S + memory.measurement[world, i, n].by_map * wp.transpose(memory.map_projection[world, i, m, slot])
    return S


@device_function
def innovation_weight(memory: Any, world: int, i: int, n: int, noise: Any):
    """Return the inverse of the innovation's covariance of a projected bearing with a noise per axis, rad^2."""
    return wp.inverse(noise * wp.identity(2, wp.float64) + innovation_cross_covariance(memory, world, i, n, n))


@device_function
def innovation_with(memory: Any, world: int, i: int, n: int, noise: Any):
    """Return the normalised innovation squared of a projected bearing with a noise per axis, rad^2."""
    residual = memory.measurement[world, i, n].residual
    return wp.dot(residual, innovation_weight(memory, world, i, n, noise) * residual)


@subroutine
def innovation_squared(frame: BearingFrame, memory: Any, world: int, i: int, n: int):
    """Linearise a bearing and return its normalised innovation squared, infinite for a target behind the camera.

    Its `projection` is set to H P.
    """
    if not linearise(frame, memory, world, i, n):
        return wp.float64(wp.inf)
    project(memory, world, i, n)
    return innovation_with(memory, world, i, n, memory.measurement[world, i, n].noise)
