"""Finding a pose from nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.estimation.metrics import orientation_error_deg
from coopenv.observers.contract import MIN_BEARING_STD
from tests.helpers.robust_scenes import first_tick, noise_free
from tests.oracles.robust.search import Search, Sighting, is_known

WIDE = np.diag([1.8] * 3 + [45.0] * 3)
NO_NOISE = np.repeat([1e-10, 1e-8], 3)


def sightings(recording, k):
    tick = first_tick(recording, 0, k)
    return tick, [Sighting(b, z, 0.0) for b, z in zip(tick.bearings, tick.landmarks, strict=True)]


def searched(recording, search, ticks):
    for k in range(1, ticks):
        tick, seen = sightings(recording, k)
        search.move(tick, NO_NOISE)
        found = search.look(tick, seen, MIN_BEARING_STD**2)
        if found is not None:
            return k, found
    return ticks, None


@pytest.mark.parametrize("seed", range(4))
def test_motion_tells_the_solutions_apart(seed):
    recording = noise_free(3.0)
    rng = np.random.default_rng(seed)
    R = Rotation.random(None, rng).as_matrix()
    search = Search(0, R, recording.truth.position[0, 0] + rng.normal(size=3) * 5, WIDE.copy())
    k, found = searched(recording, search, recording.ticks)
    assert found is not None
    assert np.linalg.norm(found.own.p - recording.truth.position[k, 0]) < 0.05
    assert orientation_error_deg(recording.truth.rotation[k, 0], found.own.R) < 0.5


def test_a_mirrored_start_is_no_obstacle():
    """Half a turn off, with all targets behind the camera: where the paper's observer stays."""
    recording = noise_free(3.0)
    half_turn = np.diag([-1.0, -1.0, 1.0])
    search = Search(0, recording.truth.rotation[0, 0] @ half_turn, recording.truth.position[0, 0], WIDE.copy())
    k, found = searched(recording, search, recording.ticks)
    assert found is not None
    assert orientation_error_deg(recording.truth.rotation[k, 0], found.own.R) < 0.5


def test_nothing_is_found_with_two_targets():
    recording = noise_free(3.0)
    search = Search(0, np.eye(3), np.zeros(3), WIDE.copy())
    for k in range(1, 60):
        tick, seen = sightings(recording, k)
        search.move(tick, NO_NOISE)
        assert search.look(tick, seen[:2], MIN_BEARING_STD**2) is None
    assert search.bank == []
    assert search.best is search.prior


def test_a_vehicle_that_stands_still_stays_undecided_between_real_solutions():
    """From one place several poses explain three bearings; only motion, or the prior, tells them apart."""
    recording = noise_free(3.0)
    tick, seen = sightings(recording, 1)
    still = replace(tick, rotation=np.eye(3), translation=np.zeros(3))
    search = Search(0, np.eye(3), np.zeros(3), 1e4 * np.eye(6))
    solutions = set()
    for _ in range(60):
        search.move(still, NO_NOISE)
        search.look(still, seen, MIN_BEARING_STD**2)
        solutions.add(len(search.bank))
    assert max(solutions) > 1
    assert len(search.bank) > 1


def test_wrong_bearings_end_in_no_pose():
    recording = noise_free(3.0)
    rng = np.random.default_rng(0)
    search = Search(0, np.eye(3), np.zeros(3), WIDE.copy())
    for k in range(1, 120):
        tick, seen = sightings(recording, k)
        order = rng.permutation(3)
        search.move(tick, NO_NOISE)
        found = search.look(tick, [replace(s, z=seen[order[n]].z) for n, s in enumerate(seen)], MIN_BEARING_STD**2)
        assert found is None


def test_known_means_small_enough_to_linearise():
    assert is_known(np.diag([0.01] * 3 + [1.0] * 3))
    assert not is_known(np.diag([0.01, 0.01, 0.5, 1.0, 1.0, 1.0]))
    assert not is_known(np.diag([0.01] * 3 + [1.0, 1.0, 9.0]))
