"""The poses that agree with three bearings, or with what those may have been.

Where two solutions of P3P lie close together noise can make both of them vanish. So every bearing, and every position
that is not exactly known, is also perturbed by some standard deviations to each side.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import distance_squared, inverse6, is_known, is_regular
from coopenv.observers.robust.belief import begin_belief
from coopenv.observers.robust.measurements import linearise, tangent_basis
from coopenv.observers.robust.memory import Estimate, Frame, Pose, mat33d, mat66d
from coopenv.observers.robust.p3p import camera_pose, solve_triangle
from coopenv.world.device_function import device_function


@device_function
def next_triple(memory: Any, world: int, count: int, size: Any, number: int):
    """Return (bearings, size, number) of the triple that spans most after the one of this size and number.

    The size is twice the area that three bearings span; a good triple looks in three very different directions.
    """
    best = wp.vec3i(-1, -1, -1)
    best_size = wp.float64(-1.0)
    best_number = int(0)
    here = int(0)
    for n0 in range(count):
        for n1 in range(n0 + 1, count):
            for n2 in range(n1 + 1, count):
                a = memory.line[world, n0].bearing
                area = wp.length(wp.cross(memory.line[world, n1].bearing - a, memory.line[world, n2].bearing - a))
                later = area < size or (area == size and here > number)
                if later and area > best_size:
                    best = wp.vec3i(n0, n1, n2)
                    best_size = area
                    best_number = here
                here += 1
    return best, best_size, best_number


@wp.func
def angles_within(P: Any, most: Any) -> bool:
    """Return whether all variances of angles are what an inverse that exists may have, and no larger than `most`."""
    for k in range(3):
        if not (P[k, k] > wp.float64(0.0) and P[k, k] <= most):
            return False
    return True


@device_function
def covariance_of(frame: Frame, memory: Any, world: int, i: int, lines: Any, patient: bool):
    """Return whether three bearings determine the pose believed well enough, and its covariance."""
    M = mat66d()
    for n in range(3):
        linearise(frame, memory, world, i, lines[n])
        H = memory.line[world, lines[n]].jacobian
        M += (wp.transpose(H) * (wp.float64(1.0) / memory.line[world, lines[n]].noise)) * H
    P = symmetric_part(inverse6(M))
    if patient:
        return is_known(P), P
    return angles_within(P, wp.float64(1.0)) and is_regular(M, P, wp.float64(constants.MAX_CONDITION)), P


@device_function
def is_new(memory: Any, world: int, i: int, h: int, count: int) -> bool:
    """Return whether a hypothesis can be told apart from each of the first `count`."""
    for g in range(count):
        distance = distance_squared(memory.hypothesis[world, i, h].estimate, memory.hypothesis[world, i, g].estimate)
        if distance < wp.float64(constants.SAME_HYPOTHESIS):
            return False
    return True


@device_function
def add_hypothesis(memory: Any, world: int, i: int, estimate: Estimate):
    """Add a hypothesis, unless there is one like it."""
    h = memory.search[world, i].hypotheses
    if h < constants.MAX_HYPOTHESES:
        memory.hypothesis[world, i, h].estimate = estimate
        if is_new(memory, world, i, h, h):
            memory.search[world, i].hypotheses = h + 1


@device_function
def solve(frame: Frame, memory: Any, world: int, i: int, lines: Any, b: Any, z: Any, patient: bool, following: bool):
    """Solve one problem of bearings b and points z, rows; return whether `patient` finds all solutions determined.

    They become hypotheses if they are to be followed.
    """
    count, distances = solve_triangle(b, z)
    for n in range(count):
        R, camera = camera_pose(b, z, distances[n])
        if wp.isfinite(wp.ddot(R, R) + wp.dot(camera, camera)):
            pose = Pose(R, camera - R * frame.lever)
            begin_belief(memory, world, i, Estimate(pose, mat66d()))
            determined, P = covariance_of(frame, memory, world, i, lines, patient)
            if patient and not determined:
                return False
            if following and determined:
                add_hypothesis(memory, world, i, Estimate(pose, P))
    return True


@device_function
def problem(frame: Frame, memory: Any, world: int, lines: Any, number: int):
    """Return whether there is the problem of a number, below `PROBLEMS`, and its bearings and points, rows.

    The first is as measured. In the others a bearing is perturbed along an axis across it, or its point if that is not
    exactly known, to one side or the other.
    """
    b = mat33d()
    z = mat33d()
    for n in range(3):
        b[n] = memory.line[world, lines[n]].bearing
        z[n] = memory.line[world, lines[n]].point
    exists = bool(True)
    if number > 0:
        n = (number - 1) // 10
        axis = (number - 1) % 5
        step = wp.float64(constants.PERTURBATION)
        if (number - 1) // 5 % 2 == 1:
            step = -step
        if axis < 2:
            across = step * wp.sqrt(frame.variance)
            b[n] = wp.normalize(b[n] + across * tangent_basis(b[n])[axis])
        else:
            variance = memory.line[world, lines[n]].variance / wp.float64(constants.CORRELATION_FACTOR)
            z[n, axis - 2] = z[n, axis - 2] + step * wp.sqrt(variance)
            exists = variance > wp.float64(0.0)
    return exists, b, z


@device_function
def solve_triple(frame: Frame, memory: Any, world: int, i: int, lines: Any, patient: bool, following: bool) -> bool:
    """Make hypotheses of the poses that agree with three bearings, in their order, if they are to be followed.

    Return False, without hypotheses, if a solution is not well determined and one is `patient` enough to wait.
    """
    memory.search[world, i].hypotheses = 0
    for number in range(constants.PROBLEMS):
        exists, b, z = problem(frame, memory, world, lines, number)
        if exists:
            if not solve(frame, memory, world, i, lines, b, z, patient, following):
                memory.search[world, i].hypotheses = 0
                return False
    return True
