"""What others say against their odometry and against bearings, as the oracle weighs it, against simulated truth."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from coopenv.observers.contract import SensorNoise
from coopenv.observers.robust.constants import DRIFT_GATE, NEWS_TIME, SLACK, WORD_GATE
from tests.oracles.robust.belief import Belief, Member
from tests.oracles.robust.tracklets import Report
from tests.oracles.robust.words import Word

NOISE = SensorNoise(0.1, 0.01, 1.0 / 60.0, 0.003)
STEADY = 0.02  # m, what the sender knows its place by


def reports(rng: np.random.Generator, count: int, drift: float = 0.0) -> list[Report]:
    """Return the reports of a sender that goes straight on, that knows its place equally well all the time."""
    P = np.diag([1e-6] * 3 + [STEADY**2] * 3)
    q = float(NOISE.odometry(NEWS_TIME)[3])
    gain = q / (STEADY**2 + q)  # of a filter that is in balance
    error, odometry, true, found = rng.normal(0.0, STEADY, 3), np.zeros(3), np.zeros(3), []
    way = np.array([2.0, 0.0, 0.0])
    for k in range(count):
        slip = rng.normal(0.0, np.sqrt(q), 3)
        true, odometry, error = true + way, odometry + way + slip, error + slip
        measured = error + rng.normal(0.0, STEADY * np.sqrt(1.0 + STEADY**2 / q), 3)
        error = error - gain * measured
        told = true + error + np.array([0.0, drift * NEWS_TIME * k, 0.0])
        time = NEWS_TIME * k
        found.append(Report((1,), np.array([time]), np.eye(3)[None], told[None], np.eye(3)[None], odometry[None], P, 0))
    return found


def sizes(drift: float, seed: int, count: int = 60) -> list[float]:
    """Return the squared sizes of a sender's drift, report by report."""
    word, found = Word(), []
    told = reports(np.random.default_rng(seed), count, drift)
    for last, new in pairwise(told):
        word.step(last, new, NOISE, None)
        found.append(float(word.drift.sum.dot(np.linalg.solve(word.drift.covariance, word.drift.sum))))
    return found


def test_honest_steps_are_as_large_as_they_should_be() -> None:
    """Their sum is of three dimensions, and its covariance is a little larger than it has to be."""
    mean = np.mean([sizes(0.0, seed)[-1] for seed in range(200)])
    assert 3.0 / (1.0 + SLACK) * 0.8 < mean < 3.0 * 1.2


def test_a_drift_is_found_after_some_seconds() -> None:
    late = np.array([sizes(0.05, seed) for seed in range(40)])
    assert (late.max(axis=1) > DRIFT_GATE).mean() > 0.9
    assert (np.array([sizes(0.0, seed) for seed in range(40)]).max(axis=1) < DRIFT_GATE).all()


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_bearings_tell_of_an_offset(offset: float) -> None:
    """Positions that are measured directly: the correction is that of a Kalman filter."""
    rng, word = np.random.default_rng(0), Word()
    P, R = STEADY**2 * np.eye(3), 0.05**2 * np.eye(3)
    K = P.dot(np.linalg.inv(P + R))
    for _ in range(30):
        residual = offset * np.array([0.0, 1.0, 0.0]) + rng.multivariate_normal(np.zeros(3), R)
        word.weigh(np.eye(3), P, K.dot(residual), K.dot(P), 1.0)
    size, error = word.contradiction(np.eye(3), P)
    assert (size > WORD_GATE) == (offset > 0.0)
    assert error == pytest.approx(offset, abs=0.05)


def test_what_depends_on_a_sender_becomes_uncertain_with_it() -> None:
    """With e = L e_s + w the covariance of e grows by that of L times what is added."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6)) * 0.1
    sender = A.dot(A.T) + 1e-3 * np.eye(6)
    L, W = rng.normal(size=(6, 6)), 1e-2 * np.eye(6)
    own = L.dot(sender).dot(L.T) + W
    belief = Belief(0, np.eye(3), np.zeros(3), own)
    belief.add([Member(1, np.eye(3), np.zeros(3))], sender)
    belief.P[:6, 6:] = L.dot(sender)
    belief.P[6:, :6] = belief.P[:6, 6:].T
    belief.enlarge(1, 0.25)
    larger = sender + np.diag([0.0] * 3 + [0.25] * 3)
    np.testing.assert_allclose(belief.P[6:, 6:], larger, atol=1e-12)
    np.testing.assert_allclose(belief.P[:6, :6], L.dot(larger).dot(L.T) + W, atol=1e-10)
    np.testing.assert_allclose(belief.P[:6, 6:], L.dot(larger), atol=1e-10)
