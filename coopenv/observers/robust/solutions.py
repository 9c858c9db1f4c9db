"""The poses that agree with three bearings, or with what those may have been.

Where two solutions of P3P lie close together noise can make both of them vanish. So every bearing, and every position
that is not exactly known, is also perturbed by some standard deviations to each side.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import inverse6, is_known, is_regular, with_noise
from coopenv.observers.robust.belief import begin_belief
from coopenv.observers.robust.constants import CORRELATION_FACTOR, MAX_HYPOTHESES, MIN_INFORMATION_RATIO, PERTURBATION
from coopenv.observers.robust.hypotheses import is_new, store_hypothesis
from coopenv.observers.robust.measurements import bearing_variance, linearise, tangent_basis
from coopenv.observers.robust.p3p import axes_of, is_sound, solutions_of
from coopenv.observers.robust.types import mat33d, mat66d, vec3d, wide_vector


@wp.func
def information_of(model: Any, memory: Any, world: int, i: int, n: int):
    """Return the information of a bearing about the pose believed, H^T H over its variance."""
    linearise(model, memory, world, i, n)
    H = memory.line[world, n].jacobian
    return (wp.transpose(H) * H) / memory.line[world, n].noise


@wp.func
def angles_within(P: Any, most: Any) -> bool:
    """Return whether all variances of angles are what an inverse that exists may have, and no larger than `most`."""
    for k in range(3):
        if not (P[k, k] > wp.float64(0.0) and P[k, k] <= most):
            return False
    return True


@wp.func
def covariance_of(model: Any, memory: Any, world: int, i: int, lines: Any, patient: bool):
    """Return whether three bearings determine the pose believed well enough, and its covariance."""
    M = information_of(model, memory, world, i, lines[0])
    M += information_of(model, memory, world, i, lines[1])
    M += information_of(model, memory, world, i, lines[2])
    P = with_noise(inverse6(M), wp.float64(0.0), wp.float64(0.0))
    if patient:  # then the information is far from singular, and needs no costly spectrum
        return is_known(P), P
    return angles_within(P, wp.float64(1.0)) and is_regular(M, wp.float64(MIN_INFORMATION_RATIO)), P


@wp.func
def add_hypothesis(memory: Any, world: int, i: int):
    """Make what is believed a hypothesis, unless there is one like it."""
    h = memory.search[world, i].hypotheses
    if h < MAX_HYPOTHESES:
        store_hypothesis(memory, world, i, h)
        if is_new(memory, world, i, h, h):
            memory.search[world, i].hypotheses = h + 1


@wp.func
def solve(model: Any, memory: Any, world: int, i: int, lines: Any, b: Any, z: Any, patient: bool, following: bool):
    """Solve one problem of bearings b and points z, rows; return whether `patient` finds all solutions determined.

    They become hypotheses if they are to be followed.
    """
    a = vec3d(wp.length_sq(z[0] - z[1]), wp.length_sq(z[0] - z[2]), wp.length_sq(z[1] - z[2]))
    longest = wp.max(wp.max(a[0], a[1]), a[2])
    if not is_sound(b[0], b[1], b[2], z[0], z[1], z[2], longest):
        return True
    gaps = vec3d(wp.length_sq(b[0] - b[1]), wp.length_sq(b[0] - b[2]), wp.length_sq(b[1] - b[2]))
    count, distances = solutions_of(a / longest, gaps)
    axes = axes_of(z[0], z[1], z[2])
    third = wp.float64(1.0) / wp.float64(3.0)
    for n in range(count):
        d = distances[n] * wp.sqrt(longest)
        p0 = d[0] * b[0]
        p1 = d[1] * b[1]
        p2 = d[2] * b[2]
        R = axes * wp.transpose(axes_of(p0, p1, p2))
        camera = (z[0] + z[1] + z[2]) * third - R * ((p0 + p1 + p2) * third)
        if wp.isfinite(wp.ddot(R, R) + wp.dot(camera, camera)):
            begin_belief(memory, world, i, R, camera - R * wide_vector(model.camera.position), mat66d())
            determined, P = covariance_of(model, memory, world, i, lines, patient)
            if patient and not determined:
                return False
            if following and determined:
                memory.P[world, i, 0, 0] = P
                add_hypothesis(memory, world, i)
    return True


@wp.func
def perturbed_bearing(b: Any, axis: int, step: Any):
    """Return a bearing moved along an axis across it."""
    return wp.normalize(b + step * tangent_basis(b)[axis])


@wp.func
def solve_perturbed(
    model: Any, memory: Any, world: int, i: int, lines: Any, b: Any, z: Any, n: int, patient: bool, following: bool
):
    """Solve the problems in which the n-th bearing or point is perturbed; return as `solve` does.

    To each side there are five: two axes across the bearing, three of the point.
    """
    variance = memory.line[world, lines[n]].variance / wp.float64(CORRELATION_FACTOR)
    step = wp.float64(PERTURBATION)
    for _ in range(2):
        for axis in range(5):
            moved_b = b
            moved_z = z
            if axis < 2:
                moved_b[n] = perturbed_bearing(b[n], axis, step * wp.sqrt(bearing_variance(model)))
            else:
                moved_z[n, axis - 2] = z[n, axis - 2] + step * wp.sqrt(variance)
            if axis < 2 or variance > wp.float64(0.0):
                if not solve(model, memory, world, i, lines, moved_b, moved_z, patient, following):
                    return False
        step = -step
    return True


@wp.func
def solve_triple(model: Any, memory: Any, world: int, i: int, lines: Any, patient: bool, following: bool) -> bool:
    """Make hypotheses of the poses that agree with three bearings, in their order, if they are to be followed.

    Return False, without hypotheses, if a solution is not well determined and one is `patient` enough to wait.
    """
    memory.search[world, i].hypotheses = 0
    b = mat33d()
    z = mat33d()
    for n in range(3):
        b[n] = memory.line[world, lines[n]].bearing
        z[n] = memory.line[world, lines[n]].point
    determined = solve(model, memory, world, i, lines, b, z, patient, following)
    for n in range(3):
        if determined:
            determined = solve_perturbed(model, memory, world, i, lines, b, z, n, patient, following)
    if not determined:
        memory.search[world, i].hypotheses = 0
    return determined
