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
    """Return the displacements (rows, M, P, 2), m, of vehicles in times (P,), s, on circles.

    Velocities (rows, M, 2) are in m/s, curvatures (rows, M) in 1/m.
    """
    half = (curvature * np.linalg.norm(velocity, axis=-1))[..., None] * (times / 2.0)  # rad, from velocity to chord
    (x, y), c, s = np.moveaxis(velocity[..., None, :], -1, 0), np.cos(half), np.sin(half)
    return np.asarray((times * np.sinc(half / np.pi))[..., None] * np.stack([c * x - s * y, s * x + c * y], axis=-1))


MOST_ROWS = 256
"""Rows at once: arrays of more do not fit into the processor's cache."""


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
    if len(path) > MOST_ROWS:
        parts = []
        for first in range(0, len(path), MOST_ROWS):
            part = slice(first, first + MOST_ROWS)
            bends = None if curvature is None else curvature[part]
            parts.append(nearest(path[part], times, place[part], velocity[part], mask[part], until, bends))
        return np.concatenate(parts)
    count = int(np.searchsorted(times[1:-1], until)) + 1  # of the lines that begin before
    own = np.diff(path[:, : count + 1], axis=1) / np.diff(times[: count + 1])[:, None]
    if count == len(times) - 1:
        times = np.append(times[:-1], max(until, times[-1]))
    times, lasts = times[: count + 1], np.diff(times[: count + 1])
    speed = velocity[:, :, None]
    driven = speed * times[:, None]
    if curvature is not None:
        driven = on_circle(velocity, curvature, times)
        speed = np.diff(driven, axis=2) / lasts[:, None]
    apart = place[:, :, None] + driven[:, :, :-1] - path[:, None, :count]
    away = speed - own[:, None]
    square = np.maximum((away**2).sum(axis=-1), 1e-9)
    time = np.clip(-(apart * away).sum(axis=-1) / square, 0.0, np.minimum(times[1:], until) - times[:-1])
    distance = np.linalg.norm(apart + time[..., None] * away, axis=-1).min(axis=-1)
    return np.asarray(np.min(distance, axis=1, where=mask, initial=np.inf))
