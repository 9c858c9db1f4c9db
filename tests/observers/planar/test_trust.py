"""Whose word a planar robot believes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coopenv.backends.mrclam import recording_of
from coopenv.observers.planar.robust import PlanarRobust
from coopenv.observers.planar.state import PlanarPose
from coopenv.observers.planar.trust import ENOUGH, Trust
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


class Lying:
    """The first robot broadcasts places that are off by `jump` m and drift on by `drift` m/s from 15 s on."""

    def __init__(self, jump: float, drift: float) -> None:
        self.jump, self.drift, self.now = jump, drift, 0.0

    def applies(self, vehicle, time):
        self.now = time
        return vehicle == 0 and time >= 15.0

    def told(self, observer, message):
        off = (self.jump + self.drift * (self.now - 15.0)) * np.array([0.6, 0.8, 0.0])
        if message.position is None:
            return message
        return observer.tampered(replace(message, position=message.position + off))


@pytest.fixture(scope="module")
def nominal():
    record = recording_of(barrier_robots(31, 70.0, 0.8), "landmarks+robots")
    return record, run(PlanarRobust, record)


@pytest.mark.parametrize(("jump", "drift"), [(5.0, 0.0), (0.0, 0.05)])
def test_a_liar_costs_the_honest_ones_at_most_twice_their_error(nominal, jump, drift):
    record, honest = nominal
    result = run(PlanarRobust, record, Lying(jump, drift))
    assert not result.failure
    assert result.position_rmse()[1:].mean() < 1.5 * honest.position_rmse()[1:].mean()
    assert (result.position_rmse()[1:] < 2.0 * honest.position_rmse()[1:]).all()
    assert (result.anees(after=record.dt)[1:] < 3.0).all()


@pytest.mark.slow
def test_a_jump_is_found_out_by_robots_that_see_no_landmark():
    """A drift is not: blind robots have the liar's word and one other, and neither is likelier than the other."""
    record = recording_of(barrier_robots(32, 100.0, 0.8), "blind")
    honest, result = run(PlanarRobust, record), run(PlanarRobust, record, Lying(5.0, 0.0))
    assert result.position_rmse()[1:].mean() < 2.0 * honest.position_rmse()[1:].mean()
