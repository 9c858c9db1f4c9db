"""Whose word a planar robot believes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.planar.changes import blindfolded
from benchmarks.planar.lies import Drifting
from coopenv.backends.mrclam import recording_of
from coopenv.observers.planar.fusion import ENOUGH, Trust
from coopenv.observers.planar.model import PlanarPose, misfit
from coopenv.observers.planar.plugin import PlanarRobust
from coopenv.observers.runner import run
from tests.helpers.barrier_robots import barrier_robots


def at(x: float, std: float = 0.05) -> PlanarPose:
    return PlanarPose(np.array([x, 0.0, 0.0]), np.diag([std**2, std**2, 0.0]))


def test_who_drives_is_believed_and_who_jumps_is_not():
    trust = Trust()
    for k in range(100):
        trust.hear(0.1 * k, at(0.03 * k))
    assert trust.believed
    trust.hear(10.0, at(8.0))
    assert not trust.believed


def test_who_was_silent_or_said_to_be_unsure_may_be_elsewhere():
    trust = Trust()
    trust.hear(0.0, at(0.0))
    trust.hear(0.1, at(0.9, std=1.0))
    trust.hear(3.0, at(7.0))
    assert trust.believed


def test_sightings_that_fit_badly_add_up_and_good_ones_make_up_for_them():
    rng = np.random.default_rng(1)
    honest, drifting = Trust(), Trust()
    for _ in range(3000):
        honest.see(float(rng.chisquare(1)), 1e-3, sure=True)
    for _ in range(30):
        drifting.see(5.0, 1e-3, sure=True)
    assert honest.believed and not drifting.believed
    for _ in range(ENOUGH):
        drifting.see(0.5, 1e-3, sure=False)
    assert not drifting.believed  # by who is not sure of its own place
    for _ in range(ENOUGH):
        drifting.see(0.5, 1e-3, sure=True)
    assert drifting.believed


def accuse(everyone: dict[int, Trust], target: int, by: int, times: int = 5) -> None:
    for _ in range(times):
        everyone[target].witness(by, 20.0, 1e-3)


def test_a_robot_that_sees_landmarks_is_accused_by_two_and_another_by_one():
    everyone = {n: Trust() for n in range(4)}
    accuse(everyone, 0, by=1)
    assert everyone[0].accused(10.0, everyone)  # of whom nothing says that it sees landmarks
    everyone[0].claim(10.0, True)
    assert not everyone[0].accused(12.0, everyone) and everyone[0].accused(30.0, everyone)
    accuse(everyone, 0, by=2)
    assert everyone[0].accused(12.0, everyone)


def test_two_against_two_is_not_decided_and_a_liar_cannot_accuse_two():
    everyone = {n: Trust() for n in range(4)}
    for trust in everyone.values():
        trust.claim(10.0, True)
    for liar, honest in ((0, 2), (0, 3)):
        accuse(everyone, honest, by=liar)
        accuse(everyone, liar, by=honest)
    assert [everyone[n].accused(12.0, everyone) for n in range(4)] == [True, False, False, False]
    for liar, honest in ((1, 2), (1, 3)):
        accuse(everyone, honest, by=liar)
        accuse(everyone, liar, by=honest)
    assert not any(trust.accused(12.0, everyone) for trust in everyone.values())


def test_what_witnesses_see_again_as_told_is_believed_again():
    everyone = {0: Trust(), 1: Trust()}
    accuse(everyone, 0, by=1)
    everyone[0].doubt()
    for _ in range(ENOUGH - 1):
        everyone[0].witness(1, 0.5, 1e-3)
    assert not everyone[0].believed
    everyone[0].witness(1, 0.5, 1e-3)
    assert everyone[0].believed and not everyone[0].accusers()


def test_how_far_a_bearing_is_off_is_as_drawn():
    rng = np.random.default_rng(3)
    P, Q = np.diag([0.02, 0.01, 0.02]) ** 2 + 1e-5, np.diag([0.05, 0.03, 0.0]) ** 2
    by, to, std = np.array([1.0, -1.0, 2.0]), np.array([3.0, 2.0, 0.0]), 0.02
    direction = np.arctan2(3.0, 2.0) - by[2] + std * rng.standard_normal(4000)
    told = zip(rng.multivariate_normal(by, P, 4000), rng.multivariate_normal(to, Q, 4000), direction, strict=True)
    squares = [misfit(b, PlanarPose(one, P), PlanarPose(other, Q), std)[0] for one, other, b in told]
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.fixture(scope="module")
def nominal():
    record = recording_of(barrier_robots(31, 40.0, 0.8), "landmarks+robots")
    return record, run(PlanarRobust, record)


@pytest.mark.parametrize(("jump", "drift"), [(5.0, 0.0), (0.0, 0.05)])
def test_a_liar_costs_the_honest_ones_at_most_twice_their_error(nominal, jump, drift):
    record, honest = nominal
    result = run(PlanarRobust, record, Drifting([0], jump, drift))
    assert not result.failure
    assert result.position_rmse()[1:].mean() < 1.5 * honest.position_rmse()[1:].mean()
    assert (result.position_rmse()[1:] < 2.0 * honest.position_rmse()[1:]).all()
    assert (result.anees(after=record.dt)[1:] < 3.0).all()


def test_robots_that_see_no_landmark_shun_whom_two_others_contradict():
    """Robots 4 and 5 see none; of the others the first drifts away by 15 cm/s."""
    Watched.all = []
    record = recording_of(blindfolded(barrier_robots(32, 30.0, 0.8), 4, 5), "landmarks+robots")
    assert not run(Watched, record, Drifting([0], 0.0, 0.15, since=5.0)).failure
    believed = np.array([[one.believes(target) for target in range(15, 20)] for one in Watched.all])
    np.testing.assert_array_equal(believed[1:], np.tile([False, True, True, True, True], (4, 1)))


class Watched(PlanarRobust):
    """Tells whom it believes."""

    all: list[Watched]

    def __init__(self, setup):
        super().__init__(setup)
        Watched.all.append(self)

    def believes(self, target: int) -> bool:
        return self._circle.of(target).believed


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "jump", "drift"), [(32, 0.0, 0.05), (51, 0.0, 0.05), (52, 5.0, 0.0)])
def test_robots_that_see_no_landmark_judge_by_two_that_do(seed, jump, drift):
    """Three see landmarks, of whom one lies: there are two honest ways to the truth."""
    record = recording_of(blindfolded(barrier_robots(seed, 100.0, 0.8), 4, 5), "landmarks+robots")
    honest, result = run(PlanarRobust, record), run(PlanarRobust, record, Drifting([0], jump, drift))
    assert not result.failure
    assert result.position_rmse()[1:].mean() < 2.0 * honest.position_rmse()[1:].mean()


@pytest.mark.slow
def test_a_jump_is_found_out_by_robots_that_see_no_landmark():
    """A drift is not: blind robots have the liar's word and one other, and neither is likelier than the other."""
    record = recording_of(barrier_robots(32, 100.0, 0.8), "blind")
    honest, result = run(PlanarRobust, record), run(PlanarRobust, record, Drifting([0], 5.0, 0.0))
    assert result.position_rmse()[1:].mean() < 2.0 * honest.position_rmse()[1:].mean()
