"""The poses that explain three sightings, or what those may have been. See observers/robust/search.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.observers.robust.algebra import inverse6, is_known, is_regular, with_noise
from coopenv.observers.robust.belief import begin
from coopenv.observers.robust.hypotheses import is_new, keep
from coopenv.observers.robust.measurements import bearing_variance, draw, tangent_basis
from coopenv.observers.robust.p3p import axes_of, is_sound, solutions_of
from coopenv.observers.robust.reference.search import MOVED, SLOW
from coopenv.observers.robust.state import MOST_SUPPOSED
from coopenv.observers.robust.types import mat66d, vec3d, wide_vector

PROBLEMS = wp.constant(31)
"""The sightings as they are, then each moved to both sides along two axes of the bearing and three of the place."""
STANDARD_DEVIATIONS = wp.constant(MOVED)
SLOWNESS = wp.constant(SLOW)
LEAST_INFORMATION = wp.constant(1e-12)
"""Least information of the weakest direction relative to the strongest."""
ROOTS = wp.constant(4)
"""Most solutions of the P3P problem."""


@wp.func
def information_of(model: Any, mind: Any, world: int, i: int, n: int):
    """Return what a sighting says of the pose believed, H^T H over its variance."""
    draw(model, mind, world, i, n)
    H = mind.line_own[world, n]
    return (wp.transpose(H) * H) / mind.line_noise[world, n]


@wp.func
def angles_within(P: Any, most: Any) -> bool:
    """Return whether all variances of angles are what an inverse that exists may have, and no larger than `most`."""
    for k in range(3):
        if not (P[k, k] > wp.float64(0.0) and P[k, k] <= most):
            return False
    return True


@wp.func
def covariance_of(model: Any, mind: Any, world: int, i: int, lines: Any, patient: bool):
    """Return whether three sightings tell the pose believed well enough, and its covariance."""
    M = information_of(model, mind, world, i, lines[0])
    M += information_of(model, mind, world, i, lines[1])
    M += information_of(model, mind, world, i, lines[2])
    P = with_noise(inverse6(M), wp.float64(0.0), wp.float64(0.0))
    if patient:  # then the information is far from singular, and needs no costly spectrum
        return is_known(P), P
    return angles_within(P, wp.float64(1.0)) and is_regular(M, wp.float64(LEAST_INFORMATION)), P


@wp.func
def suppose(mind: Any, world: int, i: int):
    """Take what is believed into the bank, unless it is there."""
    h = mind.hypotheses[world, i]
    if h < MOST_SUPPOSED:
        keep(mind, world, i, h)
        if is_new(mind, world, i, h, h):
            mind.hypotheses[world, i] = h + 1


@wp.func
def solve(model: Any, mind: Any, world: int, i: int, lines: Any, b: Any, z: Any, patient: bool, following: bool):
    """Solve one problem of bearings b and points z, rows; return whether `patient` finds all solutions determined.

    The bank takes them in if they are to be followed.
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
            begin(mind, world, i, R, camera - R * wide_vector(model.camera.position), mat66d())
            determined, P = covariance_of(model, mind, world, i, lines, patient)
            if patient and not determined:
                return False
            if following and determined:
                mind.P[world, i, 0, 0] = P
                suppose(mind, world, i)
    return True


@wp.func
def moved_bearing(b: Any, axis: int, step: Any):
    """Return a bearing moved along an axis across it."""
    return wp.normalize(b + step * tangent_basis(b)[axis])


@wp.func
def explain(model: Any, mind: Any, world: int, i: int, lines: Any, patient: bool, following: bool) -> bool:
    """Put into the empty bank the poses that explain three sightings, in their order, if they are to be followed.

    Return False, with nothing in the bank, if a solution is not well determined and one is `patient` enough to wait.
    """
    mind.hypotheses[world, i] = 0
    for problem in range(PROBLEMS):
        b = wp.matrix_from_rows(
            mind.line_bearing[world, lines[0]], mind.line_bearing[world, lines[1]], mind.line_bearing[world, lines[2]]
        )
        z = wp.matrix_from_rows(
            mind.line_point[world, lines[0]], mind.line_point[world, lines[1]], mind.line_point[world, lines[2]]
        )
        differs = bool(True)
        if problem > 0:
            n = (problem - 1) / 10
            axis = (problem - 1) % 5
            side = wp.where((problem - 1) % 10 < 5, wp.float64(STANDARD_DEVIATIONS), -wp.float64(STANDARD_DEVIATIONS))
            if axis < 2:
                b[n] = moved_bearing(b[n], axis, side * wp.sqrt(bearing_variance(model)))
            else:
                variance = mind.line_spread[world, lines[n]] / wp.float64(SLOWNESS)
                z[n, axis - 2] = z[n, axis - 2] + side * wp.sqrt(variance)
                differs = variance > wp.float64(0.0)
        if differs:
            if not solve(model, mind, world, i, lines, b, z, patient, following):
                mind.hypotheses[world, i] = 0
                return False
    return True
