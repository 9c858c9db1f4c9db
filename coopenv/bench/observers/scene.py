"""What belongs to a record and to no observer: its bounds and its observability."""

from collections import OrderedDict
from collections.abc import Sequence
from hashlib import sha256

import numpy as np

from coopenv.bench.observers.samples import Scene, windows_of
from coopenv.estimation.arrays import Array
from coopenv.estimation.observability import analyse_observability
from coopenv.observers.bound import Bound, cramer_rao, cramer_rao_ancestors
from coopenv.observers.recording import Recording

SERIES_TICKS = 250  # instants that are kept for figures
MOST_KEPT = 2  # bounds of records; those of many vehicles take minutes, and often every seed has the same

_kept: OrderedDict[bytes, list[Bound]] = OrderedDict()


def scene_of(recording: Recording, steady_from: float, edges: Sequence[float] = ()) -> Scene:
    """Return the bounds and the observability of a record, `edges` being those of the windows to judge it in, s.

    The noise of recorded robots is not known, and so neither is their bound.
    """
    N = len(recording.setups)
    kept, unknown = kept_ticks(recording), np.full(N, np.nan)
    windows = windows_of(edges, steady_from, float(recording.t[-1]))
    known = bool(recording.truth.known.all())
    bounds: list[Bound] = []
    if known and not any(setup.planar for setup in recording.setups):
        bounds = _bounds(recording)
    steady = recording.t > steady_from
    mse = [np.mean(bound.position[steady] ** 2, axis=0) for bound in bounds] or [unknown] * 3
    within = np.full((N, len(windows)), np.nan)
    if bounds:
        within = np.array([_mean(bounds[1].position[w.ticks(recording.t)] ** 2) for w in windows]).T
    gramians = [unknown, unknown]
    if known:
        seen = analyse_observability(_Geometry(recording))
        gramians = [values.min(axis=0, initial=np.inf) for values in (seen.min_eigenvalue, seen.local_eigenvalue)]
    names = tuple(setup.name for setup in recording.setups)
    bound = bounds[0].position[kept] if bounds else np.full((len(kept), N), np.nan)
    paper_noise = any(setup.noise.image_axis is not None for setup in recording.setups)
    (joint, ancestors, single), (about_map, about_vehicle), t = mse, gramians, recording.t[kept]
    judged = (steady_from, t, bound, paper_noise, windows, within)
    return Scene(names, joint, ancestors, single, about_map, about_vehicle, *judged)


class _Geometry:
    """A record as `analyse_observability` reads it."""

    def __init__(self, recording: Recording) -> None:
        self.t, self.visible, truth = recording.t, recording.visible, recording.truth
        self.position, self.rotation = truth.position, truth.rotation
        marker = np.array([setup.marker for setup in recording.setups])
        seen = truth.position + (truth.rotation @ marker[..., None])[..., 0]  # the points of vehicles that cameras see
        self.target_position = np.concatenate([recording.landmarks, seen], axis=1)
        self.vehicles = np.array([setup.name for setup in recording.setups])


def kept_ticks(recording: Recording) -> np.ndarray:
    """Return the ticks of which figures show something."""
    return np.unique(np.linspace(0, recording.ticks - 1, SERIES_TICKS).round().astype(int))


def _mean(values: Array) -> Array:
    """Return the mean over the first axis, NaN when it is empty."""
    return np.mean(values, axis=0) if len(values) else np.full(values.shape[1:], np.nan)


def _bounds(recording: Recording) -> list[Bound]:
    """Return the bounds joint over all, over ancestors, and alone; of a record that differs in noise alone at once."""
    key = _fingerprint(recording)
    if key in _kept:
        _kept.move_to_end(key)
        return _kept[key]
    _kept[key] = [cramer_rao(recording), cramer_rao_ancestors(recording), cramer_rao(recording, joint=False)]
    while len(_kept) > MOST_KEPT:
        _kept.popitem(last=False)
    return _kept[key]


def _fingerprint(recording: Recording) -> bytes:
    """Return a digest of everything that bounds depend on: truth, visibility, noise, and what is known at the start."""
    r, digest = recording, sha256()
    for setup in r.setups:
        digest.update(repr((setup.noise, setup.landmarks)).encode())
        for part in (setup.targets, setup.marker, setup.lever_arm):
            digest.update(np.ascontiguousarray(part).tobytes())
    for array in (r.truth.rotation, r.truth.position, r.visible, r.landmarks, r.due, r.start_covariance):
        digest.update(repr((array.shape, r.dt)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()
