"""Numeric cores of `python -m benchmarks.linear_case` and `benchmarks.linearisation`."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import linear_case, linearisation


@pytest.mark.parametrize(
    ("name", "ratio"),
    [
        ("one sender, every report fused", 1.0),
        ("one sender, every twelfth, exact odometry", 1.0),
        ("common ancestor, correlation known", 1.0),
        ("common ancestor, correlation missing", (0.65 + 0.5) / 0.65),
        ("two common ancestors, product of one", 0.6 / (0.35 + 0.125)),
        ("four newcomers, common ancestor", (4.0 + 0.3) / 1.3),
        ("sixteen newcomers, common ancestor", (16.0 + 0.3) / 1.3),
    ],
)
def test_ratios_are_those_of_closed_forms(name: str, ratio: float) -> None:
    own, largest = linear_case.EXAMPLES[name]().ratios()
    assert own == pytest.approx(ratio, rel=1e-5) and largest >= own * (1.0 - 1e-9)


def test_the_statistic_is_a_chi_square_without_senders_errors_and_smaller_with_them() -> None:
    assert_allclose(linear_case.monitor(30, 1e-12), 1.0, atol=1e-6)
    assert linear_case.monitor(1, 1.0)[1] == pytest.approx(0.5, abs=0.05)


def test_the_derivative_of_a_bearing_is_that_of_its_prediction() -> None:
    random = np.random.default_rng(0)
    own, leader = random.normal(size=(2, 5, 3))
    leader[:, 1] += 6.0
    _, H, _ = linearisation.bearing(own, leader)
    for k in range(6):
        error = np.zeros((5, 6))
        error[:, k] = 1e-6
        ends = [
            linearisation.bearing(
                linearisation.moved(own, s * error[:, :3]), linearisation.moved(leader, s * error[:, 3:])
            )
            for s in (1.0, -1.0)
        ]
        assert_allclose(linearisation.wrapped(ends[0][0] - ends[1][0]) / 2e-6, H[:, k], atol=1e-8)


def test_the_constrained_point_has_the_least_bias_in_a_lane_and_the_variance_reduces_it() -> None:
    bias = {
        (point, variance): linearisation.simulate("lane", point, 40, 5.0, variance)[-1].bias
        for point, variance in (("prediction", False), ("prediction", True), ("constrained", False))
    }
    assert abs(bias["constrained", False]) < 0.01 < bias["prediction", True] < 0.5 * bias["prediction", False]


def test_an_odd_number_of_seeds_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert linearisation.main(["--seeds", "3"]) == 2 and "even number of seeds" in capsys.readouterr().err
    assert linear_case.main([]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
