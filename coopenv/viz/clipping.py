"""Lines cut off at the sides of a box, as three-dimensional axes do not do by themselves."""

import numpy as np


def clipped(path: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the parts (M, D) of a line (K, D) within a box, apart by rows of NaN, each cut where it meets a side."""
    path = np.asarray(path, float)
    if len(path) == 1:
        return path if np.all((path >= low) & (path <= high)) else np.empty((0, path.shape[1]))
    start = path[:-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        step = np.diff(path, axis=0)
        to_low, to_high = (low - start) / step, (high - start) / step
        still = step == 0
        within = (start >= low) & (start <= high)
        enter = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(to_low, to_high)).max(axis=1)
        leave = np.where(still, np.inf, np.maximum(to_low, to_high)).min(axis=1)
        enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
        drawn = enter <= leave  # False for NaN
    points: list[np.ndarray] = []
    gap = np.full(path.shape[1], np.nan)
    connected = False
    for i in np.flatnonzero(drawn):
        connected = connected and bool(drawn[i - 1]) and enter[i] == 0.0
        if not connected:
            points += [gap] if points else []
            points.append(start[i] + enter[i] * step[i] if enter[i] > 0 else start[i])
        points.append(path[i + 1] if leave[i] == 1.0 else start[i] + leave[i] * step[i])
        connected = bool(leave[i] == 1.0)
    return np.array(points).reshape(-1, path.shape[1])
