"""The joint test of a frame's measurements."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from coopenv.observers import Recording, joint_gate
from coopenv.observers.contract import Tick
from coopenv.observers.correction import SECOND_ORDER, InnovationGate, Judgement
from coopenv.observers.frame import usable_measurements
from coopenv.observers.joint_gate import fitting_together, innovation
from coopenv.observers.schmidt_kalman import SchmidtKalman
from coopenv.runs.recorder import record
from tests.helpers.recordings import completed
from tests.observers.test_filters import spd
from tests.oracles.batch import small_errors, small_record

MEASUREMENTS = 5
OWNER = np.arange(MEASUREMENTS).repeat(2)


def squared(residual: np.ndarray, S: np.ndarray, kept: list[int]) -> float:
    rows = np.isin(OWNER, kept)
    return float(residual[rows] @ np.linalg.solve(S[rows][:, rows], residual[rows]))


def largest_consistent(residual: np.ndarray, S: np.ndarray) -> list[int]:
    """Return the largest set of measurements that fit together, of several the one that fits best: all subsets."""
    for count in range(MEASUREMENTS, 0, -1):
        sets = [list(chosen) for chosen in combinations(range(MEASUREMENTS), count)]
        best = min(sets, key=lambda chosen: squared(residual, S, chosen))
        if squared(residual, S, best) <= chi2.isf(1e-3, 2 * count):
            return best
    return []


def frame(seed: int, *wrong: int) -> tuple[np.ndarray, np.ndarray]:
    """Return correct residuals with errors of the prediction in common, but for some wrong ones, and their S."""
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(2 * MEASUREMENTS, 3))
    S = H @ spd(rng, 3) @ H.T + 0.01 * np.eye(2 * MEASUREMENTS)
    residual = np.linalg.cholesky(S) @ (0.5 * rng.normal(size=2 * MEASUREMENTS))
    for n in wrong:
        residual[2 * n : 2 * n + 2] += (1.5, -2.0)
    return residual, S


@pytest.mark.parametrize("wrong", [(), (0,), (3,), (1, 4)])
@pytest.mark.parametrize("seed", range(5))
def test_the_measurements_that_are_kept_are_the_largest_set_that_fits_together(
    seed: int, wrong: tuple[int, ...]
) -> None:
    residual, S = frame(seed, *wrong)
    kept = np.flatnonzero(fitting_together(residual, S, OWNER, MEASUREMENTS)).tolist()
    assert kept == largest_consistent(residual, S)
    assert kept == [n for n in range(MEASUREMENTS) if n not in wrong]


def test_measurements_fit_together_up_to_the_quantile_of_their_rows() -> None:
    direction = np.ones(2 * MEASUREMENTS) / np.sqrt(2 * MEASUREMENTS)
    limit = np.sqrt(chi2.isf(1e-3, 2 * MEASUREMENTS))
    for factor, fits in ((0.999, True), (1.001, False)):
        assert fitting_together(factor * limit * direction, np.eye(10), OWNER, MEASUREMENTS).all() == fits


class Leader(SchmidtKalman):
    """Keeps what `innovation` makes of its frames, and the normalised innovation of the correction."""

    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]

    def update(self, tick: Tick):  # type: ignore[no-untyped-def]
        self.predict(tick)
        measured = usable_measurements(tick)
        joint = self.joint_covariance([])
        places = np.full(len(measured.targets), -1)
        r, S, owner = innovation(*self.state[1:3], joint, measured.exact().frame, self.constants, places)
        *_, nis, _ = self.considered(joint, measured.exact().frame, places)
        self.frames = [*getattr(self, "frames", []), (r, S, owner, float(nis))]
        return super().update(tick)


def test_the_innovation_of_a_frame_is_the_one_of_its_correction() -> None:
    made = small_record()
    leader = Leader(made.setups[0])
    leader.reset((made.start_rotation[0], made.start_position[0]), 1e-6 * np.eye(6))
    for k in range(1, made.ticks):
        leader.update(made.tick(k, 0, {}))
    for r, S, owner, nis in leader.frames:
        assert_allclose(r @ np.linalg.solve(S, r), nis, rtol=1e-3)
        assert (np.bincount(owner) == 2).all()


class EachAlone(SchmidtKalman):
    """Without the joint test."""

    jointly = False


def wrong_landmark(metres: float, size: float, ticks: int = 2) -> Recording:
    """Return a record with initial errors of a size, rad and m, in which the first landmark of the map is off."""
    made = record(small_errors({"horizon": ticks / 60.0, "rates.odometry": 60.0}, size), 5)
    landmarks = made.landmarks.copy()
    landmarks[:, 0] += metres * np.array([0.6, 0.8, 0.0])
    return replace(made, landmarks=landmarks)


def test_a_wrong_landmark_that_fits_alone_is_refused_beside_others() -> None:
    made = wrong_landmark(0.5, 0.05)
    jointly, alone = completed(SchmidtKalman, made), completed(EachAlone, made)
    assert (jointly.nis_dof[1, 0], alone.nis_dof[1, 0]) == (4, 6)
    assert jointly.nis[1, 0] < chi2.isf(1e-3, 4) < alone.nis[1, 0]


@pytest.mark.parametrize(("share", "fits"), [(SECOND_ORDER, True), (0.0, False)])
def test_the_second_order_error_of_a_wide_prior_refuses_nothing(
    share: float, fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(joint_gate, "SECOND_ORDER", share)
    made = small_record()
    turn = Rotation.from_rotvec([0.25, -0.2, 0.25]).as_matrix()
    leader = Leader(made.setups[0])
    leader.reset((made.start_rotation[0] @ turn, made.start_position[0]), np.diag([0.06] * 3 + [1e-6] * 3))
    leader.update(made.tick(1, 0, {}))
    r, S, owner, _ = leader.frames[0]
    assert fitting_together(r, S, owner, 3).all() == fits


def test_measurements_that_contradict_each_other_open_the_gate() -> None:
    """If most of them are refused jointly, the pose is wrong."""
    gate = InnovationGate()
    judgement: Judgement = np.ones(3, bool), np.ones(3, bool), 0.0, 0.0, np.zeros((3, 3, 2))
    opened = []
    for k in range(1, 121):
        gate.passed(k / 60.0, judgement)
        gate.refuse(3)
        opened.append(gate.is_open)
    assert not any(opened[:40])
    assert all(opened[70:])
