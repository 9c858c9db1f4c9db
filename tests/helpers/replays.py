"""The embedded observer `robust` on a record, tick by tick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coopenv.backends.replay import Replay
from coopenv.observers import Recording
from coopenv.world.world import World


class Played(NamedTuple):
    """K ticks of N vehicles."""

    rotation: np.ndarray  # (K, N, 3, 3)
    position: np.ndarray  # (K, N, 3) map, m
    covariance: np.ndarray  # (K, N, 6, 6) over (2 lambda, p)
    searching: np.ndarray  # (K, N) bool
    world: World


def replayed(recording: Recording, dtype: str = "float64", observer: str = "robust") -> Played:
    """Replay a record."""
    world = Replay(recording, "record", {"observer.name": observer}).world(1, dtype, "cpu", 1)
    world.reset([0])
    rows = []
    for tick in range(recording.ticks):
        if tick > 0:
            world.advance(1)
        R = world.view("estimate_rotation")[0].astype(float)
        p = (R @ world.view("estimate_position")[0].astype(float)[..., None])[..., 0]
        P = world.view("covariance")[0].astype(float)
        rows.append((R, p, P, world.state_arrays()["observer_search.active"].numpy()[0] == 1))
    return Played(*(np.array(column) for column in zip(*rows, strict=True)), world=world)
