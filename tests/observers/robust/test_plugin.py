"""The observer as a plug-in, and its protection levels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.bench.observers.convergence import random_start
from coopenv.bench.observers.faults import VARIANTS
from coopenv.observers import run
from coopenv.observers.robust.constants import RISK
from coopenv.observers.robust.integrity import QUANTILE, levels, own_variances
from tests.helpers.recordings import completed
from tests.helpers.robust_ticks import OpenRobust
from tests.helpers.robust_worlds import everybody_sees_everybody, noise_free, small_errors
from tests.helpers.warp_calls import Calls


@pytest.mark.parametrize("seed", [0, 1, 2, "mirrored"])
def test_any_start_is_left_behind(seed):
    mirrored = seed == "mirrored"
    start = noise_free(4.0, "busy_intersection_mirror") if mirrored else random_start(noise_free(4.0), seed)
    result = completed("robust", start)
    assert (result.position_error[-1] < 1e-3).all() and (result.orientation_error[-1] < 0.01).all()


def misled(record):
    """Return whether anybody is farther off in the end, or surer, than it should be."""
    result = completed("robust", record)
    return (result.position_error[-1] > [0.2, 0.2, 0.3, 0.6, 0.6]).any() or (result.anees(8.0) > 6.0).any()


def test_landmarks_that_are_lost_do_not_mislead():
    """Other faults are those of tests/observers/robust/test_consistency.py and test_false_messages.py."""
    lost = [VARIANTS["landmarks_lost"].applied(small_errors(12.0, seed), seed) for seed in range(2)]
    results = [completed("robust", record) for record in lost]
    off, limit = np.array([result.position_error[-1] for result in results]), np.array([0.1, 0.1, 0.15, 0.3, 0.8])
    assert (off.mean(axis=0) < limit).all() and (off < 2.0 * limit).all(), off
    assert all((result.anees(8.0) < 6.0).all() for result in results)


def test_wrong_associations_mislead_in_the_first_frames_only():
    """Uncertain by 1 m and 10 degrees, a follower cannot tell two vehicles apart, and one swap of theirs passes."""
    wrong = [VARIANTS["wrong_association"].applied(small_errors(10.0, seed), seed) for seed in range(3)]
    assert sum(misled(record) for record in wrong) <= 1
    right = small_errors(10.0)
    first = (right.t < 0.1)[:, None, None, None]
    assert not misled(replace(right, bearings=np.where(first, right.bearings, wrong[0].bearings)))


def test_a_lost_vehicle_sends_nothing_and_finds_its_place_again():
    record = small_errors(12.0)
    said = []

    class Kidnapped(OpenRobust):
        def update(self, tick):
            if tick.index == 300 and self.setup.vehicle == 0:
                pose = self.members["pose"][0]
                pose["p"] += np.array([20.0, -15.0, 1.0])
                pose["R"] = np.diag([-1.0, -1.0, 1.0]) @ pose["R"]
            return super().update(tick)

        def message(self):
            message = super().message()
            if self.setup.vehicle == 0:
                said.append(message.position is not None)
            return message

    result = completed(Kidnapped, record)
    assert said[-1] and not all(said)
    assert result.position_error[-1, 0] < 0.1
    assert (result.position_error[-1] < 0.6).all()


def test_messages_in_cycles_make_no_vehicle_overconfident():
    record = everybody_sees_everybody(8.0)
    result = completed("robust", record)
    assert (result.anees(3.0) < 2.0).all()
    assert (result.position_rmse(3.0) < run("mekf_covariance", record).position_rmse(3.0) / 3.0).all()


DRAWS = 400_000
CALLS = Calls(__name__, {}, {levels: "3 2 6 > 2", own_variances: "3 66 > 2"})


def levels_of(R: Any, P: Any, mean: Any) -> np.ndarray:
    up = R[None, 2]
    variances = CALLS(own_variances, "float64", up, P[None])
    return np.asarray(CALLS(levels, "float64", up, variances, mean[None]))[0]


def horizontal(R: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return the horizontal length, m, of left errors (n, 6), whose position part is in the body frame."""
    return np.linalg.norm((errors[:, 3:] @ R.T)[:, :2], axis=1)


@pytest.mark.parametrize("seed", range(12))
def test_errors_exceed_them_at_most_at_the_risk(seed: int) -> None:
    """Gaussian errors whose covariance has axes of very different lengths, and whose mean is up to ten of them."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * 10.0 ** rng.uniform(-3.0, 0.0, 6)
    if seed % 3 == 0:  # one dominant axis: the case in which the bound is tight
        root[:, 1:] *= 1e-3
    mean = (seed % 4) * 0.3 * rng.normal(size=6) * np.abs(root).max()
    bound = levels_of(R, root @ root.T, mean)
    errors = mean + rng.normal(size=(DRAWS, 6)) @ root.T
    reached = horizontal(R, errors), np.linalg.norm(errors[:, :3], axis=1)
    limit = RISK + 4.0 * np.sqrt(RISK / DRAWS)
    assert all(np.mean(error > level) <= limit for error, level in zip(reached, bound, strict=True))


def test_an_error_along_one_axis_is_bounded_tightly() -> None:
    R, along = Rotation.from_euler("z", 0.7).as_matrix(), np.array([0.0, 0.0, 0.3, 0.4, 0.0, 0.0])
    rng = np.random.default_rng(1)
    errors = rng.normal(size=(DRAWS, 1)) * along
    bound = levels_of(R, np.outer(along, along), np.zeros(6))
    assert_allclose(bound, QUANTILE * np.array([0.4, 0.3]), rtol=1e-12)
    exceeded = np.mean(horizontal(R, errors) > bound[0])
    assert exceeded == pytest.approx(RISK, abs=4.0 * np.sqrt(RISK / DRAWS))


def test_errors_along_the_vertical_do_not_count() -> None:
    """Whatever the attitude of the vehicle: the vertical is that of the map."""
    R = Rotation.from_rotvec([0.4, -0.9, 2.0]).as_matrix()
    up = np.concatenate([np.zeros(3), R.T @ [0.0, 0.0, 1.0]])
    assert_allclose(levels_of(R, np.outer(up, up), 5.0 * up), 0.0, atol=1e-6)
