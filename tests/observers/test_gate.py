"""The gate of the zoo: what it refuses, and that no filter stays locked out of the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from coopenv.observers import Recording, run
from coopenv.observers.correction import LARGEST, InnovationGate
from coopenv.observers.error_state_filters import MekfCovariance
from coopenv.runs.recorder import record
from tests.oracles.batch import small_errors

S = 1e-4 * np.eye(2)
ALL = np.ones(3, bool)
GATED = [
    "mekf",
    "mekf_covariance",
    "covariance_intersection",
    "split_covariance_intersection",
    "iterated_ekf",
    "left_invariant",
    "right_invariant",
    "ukf",
    "pairwise",
    "schmidt_kalman",
    "centralised",
]


def residuals(*sizes: float) -> np.ndarray:
    """Return residuals of so many standard deviations."""
    return 1e-2 * np.array([[0.6 * size, -0.8 * size] for size in sizes])


def passed(gate: InnovationGate, time: float, *sizes: float, ahead: np.ndarray = ALL) -> list[bool]:
    return gate.passed(time, residuals(*sizes), np.tile(S, (len(sizes), 1, 1)), ahead[: len(sizes)]).tolist()


def test_it_refuses_one_honest_bearing_of_a_thousand() -> None:
    assert abs(chi2.sf(LARGEST, 2) - 1e-3) < 1e-7


def test_it_refuses_what_is_far_off_and_what_is_behind() -> None:
    assert passed(InnovationGate(), 0.1, 0.0, 3.6, 3.8) == [True, True, False]
    assert passed(InnovationGate(), 0.1, 0.0, 0.0, 0.0, ahead=np.array([True, False, True])) == [True, False, True]


def test_a_covariance_that_is_none_takes_nothing() -> None:
    gate = InnovationGate()
    strange = np.array([S, np.full((2, 2), np.nan), -S])
    for k in range(300):
        kept = gate.passed(k / 60, residuals(0.0, 0.0, 1.0), strange, ALL)
    assert kept.tolist() == [True, False, False]


def test_one_liar_of_two_never_opens_it_and_a_lost_pose_does() -> None:
    lied, lost = InnovationGate(), InnovationGate()
    for k in range(1200):
        assert passed(lied, k / 60, 0.0, 50.0) == [True, False]
        last = passed(lost, k / 60, 0.0, 50.0, 50.0)
        assert k > 60 or last == [True, False, False]
    assert last == [True, True, True]
    for k in range(1200, 1600):
        last = passed(lost, k / 60, 0.0, 1.0, 50.0 if k > 1500 else 1.0)
    assert last == [True, True, False]  # found again, it is as strict as before


def test_a_wide_prior_has_nothing_to_refuse_with() -> None:
    gate, wide = InnovationGate(), np.tile(np.eye(2), (3, 1, 1))
    assert gate.passed(0.1, 100.0 * residuals(5.0, 5.0, 5.0), wide, np.zeros(3, bool)).all()


def swapped(ticks: int, at: int) -> Recording:
    """Return a record in which the leader mistakes two landmarks for each other at one tick."""
    made = record(small_errors({"horizon": ticks / 60.0, "rates.odometry": 60.0}, 1e-3), 5)
    bearings = made.bearings.copy()
    bearings[at, 0, [0, 1]] = bearings[at, 0, [1, 0]]
    return replace(made, bearings=bearings)


@pytest.mark.parametrize("name", GATED)
def test_a_swap_changes_no_filter_that_has_a_gate(name: str) -> None:
    result = run(name, swapped(30, 20))
    assert not result.failure
    assert result.position_error[20, 0] < 1.5 * result.position_error[19, 0] + 0.005
    assert result.nis_dof[20, 0] == 2 or name == "centralised"


def test_the_row_without_a_gate_believes_it() -> None:
    made = swapped(30, 20)
    gated, ungated = run("mekf_covariance", made), run("mekf_covariance_ungated", made)
    assert ungated.position_error[20, 0] > 2.0 * gated.position_error[20, 0]

    class Open(MekfCovariance):
        gated = False

    assert (run(Open, made).position == ungated.position).all()


def test_a_filter_that_is_sure_of_a_wrong_pose_finds_back() -> None:
    made = swapped(180, 1)
    wrong = made.start_position + np.array([0.4, -0.3, 0.2])
    result = run("mekf_covariance", replace(made, start_position=wrong))
    assert result.position_error[30, 0] > 0.3  # it has refused what contradicts it
    assert result.position_error[-1, 0] < 0.5 * result.position_error[30, 0]
