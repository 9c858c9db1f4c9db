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


def on_circle(velocity: np.ndarray, curvature: np.ndarray, time: float) -> np.ndarray:
    """Return the displacements (rows, M, 2), m, of vehicles in a time, s, by velocities, m/s, and curvatures, 1/m."""
    half = curvature * np.linalg.norm(velocity, axis=-1) * (time / 2.0)  # rad, between the velocity and the chord
    x, y, c, s = velocity[..., 0], velocity[..., 1], np.cos(half), np.sin(half)
    return np.asarray((time * np.sinc(half / np.pi))[..., None] * np.stack([c * x - s * y, s * x + c * y], axis=-1))


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
    found = np.full(len(path), np.inf)
    for k in range(len(times) - 1):
        begin, end = times[k], times[k + 1] if k < len(times) - 2 else max(until, times[k + 1])
        own = (path[:, k + 1] - path[:, k]) / (times[k + 1] - times[k])
        driven, speed = velocity * begin, velocity
        if curvature is not None:
            driven, later = (on_circle(velocity, curvature, time) for time in (begin, end))
            speed = (later - driven) / (end - begin)
        apart = place + driven - path[:, k][:, None]
        away = speed - own[:, None]
        square = np.maximum((away**2).sum(axis=-1), 1e-9)
        time = np.clip(-(apart * away).sum(axis=-1) / square, 0.0, min(end, until) - begin)
        distance = np.linalg.norm(apart + time[..., None] * away, axis=-1)
        found = np.minimum(found, np.min(distance, axis=1, where=mask, initial=np.inf))
        if end >= until:
            break
    return found
