"""The right of way: how close vehicles come to each other, and which of them give way."""

import numpy as np

from coopenv.api.terms.layout import row_counts
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets


def discs_along(length: float, width: float) -> np.ndarray:
    """Return the centres, m, of discs that cover a box, as many as it is longer than wide."""
    count = max(1, round(length / width))
    return length * ((np.arange(count) + 0.5) / count - 0.5)


def at_arc_lengths(points: np.ndarray, distance: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return places, (rows, P, 2), at arc lengths (rows, P) of polylines (rows, K, 2) with arc lengths (K,)."""
    k = np.clip(np.searchsorted(distance, s, side="right"), 1, len(distance) - 1)
    share = ((s - distance[k - 1]) / (distance[k] - distance[k - 1]))[..., None]
    begin, end = (np.take_along_axis(points, place[..., None], axis=1) for place in (k - 1, k))
    return np.asarray(begin + share * (end - begin))


def right_of_way(scenario: Scenario) -> np.ndarray:
    """Return flags (N, N - 1) of the senders that give way to each vehicle: the driven vehicles after it in order.

    None, where some driven vehicle does not receive another one's messages. With `topology.most_nearby` the senders are
    not known, so there are (N, M) for the M kept ones, and none.
    """
    if scenario.topology.most_nearby is not None:
        return np.zeros((len(scenario.vehicles), row_counts(scenario)["neighbour"]), dtype=bool)
    driven = np.array([vehicle.motion.kind == "driven" for vehicle in scenario.vehicles])
    first, landmarks = np.triu(driven[:, None] & driven, 1), len(scenario.landmarks)
    if scenario.v2x.links != "all":
        receives = np.array([np.isin(np.arange(len(driven)) + landmarks, row) for row in neighbour_sets(scenario)])
        first &= bool((receives | ~(driven[:, None] & driven) | np.eye(len(driven), dtype=bool)).all())
    return np.asarray(first[~np.eye(len(driven), dtype=bool)].reshape(len(driven), -1))


def on_circle(velocity: np.ndarray, curvature: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the displacements (pairs, P, 2), m, of vehicles in times (P,), s, on circles.

    Velocities (pairs, 2) are in m/s, curvatures (pairs,) in 1/m.
    """
    half = (curvature * np.linalg.norm(velocity, axis=-1))[:, None] * (times / 2.0)  # rad, from velocity to chord
    (x, y), c, s = velocity.T[..., None], np.cos(half), np.sin(half)
    return np.asarray((times * np.sinc(half / np.pi))[..., None] * np.stack([c * x - s * y, s * x + c * y], axis=-1))


MOST_PAIRS = 1024  # of vehicles at once: 3,000 pairs take 5 ms, and 7 ms at once, beyond the processor's cache


def nearest(
    path: np.ndarray,
    times: np.ndarray,
    place: np.ndarray,
    velocity: np.ndarray,
    mask: np.ndarray,
    until: float,
    curvature: np.ndarray | None = None,
) -> np.ndarray:
    """Return the closest approach of other vehicles, (rows,) in m; infinite without any.

    Args:
        path: (rows, P, 2), m, own places at these times, with straight lines between and after them.
        times: (P,), s.
        place: (rows, M, 2), m, of others now.
        velocity: (rows, M, 2), m/s, of others.
        mask: (rows, M), which vehicles count.
        until: s.
        curvature: (rows, M), 1/m, of the circles that others drive along, of which chords are taken; None: straight on.
    """
    count = int(np.searchsorted(times[1:-1], until)) + 1  # of the lines that begin before
    own = np.diff(path[:, : count + 1], axis=1) / np.diff(times[: count + 1])[:, None]
    if count == len(times) - 1:
        times = np.append(times[:-1], max(until, times[-1]))
    times, lasts = times[: count + 1], np.diff(times[: count + 1])
    distance, pairs = np.full(mask.shape, np.inf), np.argwhere(mask)
    for first in range(0, len(pairs), MOST_PAIRS):
        row, other = pairs[first : first + MOST_PAIRS].T
        speed = velocity[row, other][:, None]
        driven = speed * times[:, None]
        if curvature is not None:
            driven = on_circle(velocity[row, other], curvature[row, other], times)
            speed = np.diff(driven, axis=1) / lasts[:, None]
        apart = place[row, other][:, None] + driven[:, :-1] - path[row, :count]
        away = speed - own[row]
        best = -_dot(apart, away) / np.maximum(_dot(away, away), 1e-9)
        closest = apart + np.clip(best, 0.0, np.minimum(times[1:], until) - times[:-1])[..., None] * away
        distance[row, other] = np.sqrt(_dot(closest, closest).min(axis=-1))
    return np.asarray(distance.min(axis=1, initial=np.inf))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products of vectors (..., 2): several times as fast as a sum along so short an axis."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])
