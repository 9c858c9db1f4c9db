"""Random starts follow the distributions that they claim."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import coopenv
from coopenv.bench.observers.basin import random_start, with_start
from coopenv.observers import Recording, run
from coopenv.runs.recorder import record


@cache
def made() -> Recording:
    return record(coopenv.load_scenario("busy_intersection", {"horizon": 0.1}), 0)


def test_an_observer_starts_where_it_is_told() -> None:
    R = np.asarray(Rotation.random(5, np.random.default_rng(0)).as_matrix())
    p = np.arange(15.0).reshape(5, 3)
    started = with_start(made(), R, p, np.diag(np.arange(1.0, 7.0)))
    assert_array_equal(started.start_covariance, np.broadcast_to(np.diag(np.arange(1.0, 7.0)), (5, 6, 6)))
    result = run("mekf", started)
    assert_array_equal(result.rotation[0], R)
    assert_array_equal(result.position[0], p)
    assert started.bearings is made().bearings and not started.start_rotation.flags.writeable


def test_starts_are_uniform() -> None:
    starts = [random_start(made(), seed) for seed in range(400)]
    R = np.concatenate([s.start_rotation for s in starts])
    offset = np.concatenate([s.start_position - made().truth.position[0] for s in starts])
    angle = Rotation.from_matrix(R).magnitude()
    assert kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01  # Haar measure
    assert kstest(np.linalg.norm(offset, axis=1), lambda r: (np.clip(r, 0, 15) / 15) ** 3).pvalue > 0.01
    P = starts[0].start_covariance[0]
    rotvec = Rotation.from_matrix(R).as_rotvec()
    assert_allclose(np.diag(P), [*np.mean(rotvec**2, axis=0), *np.mean(offset**2, axis=0)], rtol=0.1)


def test_a_seed_is_a_start() -> None:
    a, b, c = random_start(made(), 7), random_start(made(), 7), random_start(made(), 8)
    assert_array_equal(a.start_rotation, b.start_rotation)
    assert (a.start_position != c.start_position).all()
