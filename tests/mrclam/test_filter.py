"""The planar filter's motion, its derivatives, and what it calibrates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from coopenv.mrclam.planar_filter import Mixture, PlanarFilter
from coopenv.mrclam.planar_model import (
    ARC,
    BIAS,
    CALIBRATING,
    COMMANDED,
    DRIFT,
    HEADING,
    LEAD,
    PATH,
    SHARE,
    SLOWING,
    STATES,
    SWITCHING,
    TEXTBOOK,
    TURN,
    TURN_SCALE,
    TURNING,
    CommandHistory,
    PlanarPose,
    X,
    Y,
    growth,
    left_out,
    unsure,
)
from coopenv.mrclam.wheels import IROBOT_CREATE, Wheels
from tests.observers.test_filters import derivative

DT = 0.05
COMMANDS = [(0.07, 0.0), (0.08, 0.4), (0.05, 0.4), (0.0, -0.3), (0.067, 0.01), (0.086, -0.398), (0.086, 0.0)] * 3


def rate(t: float, column: int) -> float:
    """Return v or w that was commanded at t; tick k is (k DT, (k + 1) DT]."""
    k = math.floor(t / DT)
    return COMMANDS[k][column] if 0 <= k < len(COMMANDS) else 0.0


def history(wheels: Wheels) -> CommandHistory:
    result = CommandHistory(wheels, 0.6, DT)
    for v, w in COMMANDS:
        result.add(DT, w * DT, v * DT)
    return result


def test_response_is_the_delayed_and_spread_command():
    wheels = replace(IROBOT_CREATE, arc=((0.0, 1.0),), spot=1.0, slow_gain=0.0)
    lead, end = 0.17, len(COMMANDS) * DT
    response = history(wheels).response(DT, lead)

    def expected(function):
        breaks = np.arange(0, end, DT)
        total = 0.0
        for delay, share in zip(wheels.delay, wheels.share, strict=True):
            a, b = end - DT - lead - delay, end - lead - delay
            inside = breaks[(breaks > a) & (breaks < b)]
            total += share * quad(function, a, b, points=inside)[0]
        return total

    done = response[0]
    assert done[TURN] == pytest.approx(expected(lambda t: rate(t, 1)), abs=1e-9)
    assert done[COMMANDED] == pytest.approx(done[TURN])
    assert done[PATH] == pytest.approx(expected(lambda t: rate(t, 0)), abs=1e-9)
    assert done[ARC] == pytest.approx(expected(lambda t: float(rate(t, 1) != 0)), abs=1e-9)
    assert done[TURNING] == pytest.approx(done[ARC])
    assert done[SLOWING] == pytest.approx(expected(lambda t: rate(t, 0) * abs(rate(t, 1))), abs=1e-9)


def test_steps_of_the_rate_are_summed():
    commands = CommandHistory(Wheels(), 0.6, DT)
    total = 0.0
    for w in (0.0, 0.4, 0.4, -0.2, 0.0, 0.0):
        commands.add(DT, w * DT, 0.0)
        total += commands.response(DT, 0.0)[0][SWITCHING]
    assert total == pytest.approx(0.4**2 + 0.6**2 + 0.2**2)


def test_gains_of_the_wheels():
    assert Wheels().gain(0.1, 0.3) == 1.0
    assert IROBOT_CREATE.gain(0.0, 0.3) == IROBOT_CREATE.spot
    assert IROBOT_CREATE.gain(0.086, 0.398) == pytest.approx(0.975, abs=0.01)  # curvature 4.57 and the last knot
    assert IROBOT_CREATE.gain(0.07, 0.005 + 1.2 * 0.07) == pytest.approx((0.88 + 0.84) / 2)
    assert IROBOT_CREATE.gain(0.05, 0.005 + 1.2 * 0.05) == pytest.approx((0.88 + 0.84) / 2 + IROBOT_CREATE.slow_gain)


@pytest.mark.parametrize(("second_order", "size"), [(False, 1.0), (True, 1e-8)])  # which counts where P is large
def test_motion_derivatives_agree_with_differences(second_order, size):
    tuning = replace(CALIBRATING, walk=(0.0,) * 9, turn_noise=(0, 0, 0), path_noise=(0, 0), slide_noise=0, jitter=0)
    tuning = replace(tuning, second_order=second_order)
    x = np.array([0.3, -0.2, 0.7, 0.93, 0.97, 0.004, 0.003, 0.9, 0.183, 0.01, 0.8, 0.004])

    def filtered(state, covariance):
        own = PlanarFilter(tuning, np.zeros(3), np.zeros((3, 3)))
        own.advance(DT, 0.0, 0.0)
        own.history = history(tuning.wheels)
        own.state, own.covariance = state.copy(), covariance
        own.advance(DT, 0.02, 0.004)
        return own

    f = derivative(lambda e: filtered(x + e, size * np.eye(STATES)).state, STATES)
    f[:3, LEAD] = filtered(x, size * np.eye(STATES)).covariance[:3, LEAD] / size  # smoothed over half a tick: see below
    root = np.diag(np.arange(1.0, STATES + 1))
    np.testing.assert_allclose(filtered(x, size * root).covariance / size, f @ root @ f.T, atol=1e-6)


def test_derivative_by_the_lead_is_the_slope_across_a_tick():
    commands, lead = history(IROBOT_CREATE), 0.2
    across = (commands.response(DT, lead + DT / 2)[0] - commands.response(DT, lead - DT / 2)[0]) / DT
    np.testing.assert_allclose(commands.response(DT, lead)[1], across, atol=1e-12)


@pytest.mark.parametrize("seen", [False, True])
def test_bearing_derivatives_agree_with_differences(seen):
    own = PlanarFilter(CALIBRATING, np.array([0.1, -0.2, 0.4]), np.diag([0.04, 0.03, 0.01]))
    there = np.array([2.0, 1.0, 2.5])

    def bearing(state):
        dx, dy = there[:2] - state[[X, Y]]
        return math.atan2(-dy, -dx) - there[2] if seen else math.atan2(dy, dx) - state[HEADING] + state[BIAS]

    before, P, innovation = own.state.copy(), own.covariance.copy(), 0.02
    h = derivative(lambda e: bearing(before + e), STATES)
    own.tuning = replace(CALIBRATING, fusion="plain")
    measured = bearing(before) + innovation
    if seen:
        own.robot(measured, PlanarPose(there, np.zeros((3, 3))), seen=True)
    else:
        own.robot(measured, PlanarPose(there, np.zeros((3, 3))))
    square = float(np.sum((there[:2] - before[[X, Y]]) ** 2))
    bent = left_out(*(there[:2] - before[[X, Y]]).tolist(), square, P[:2, :2])
    gain = P @ h / (h @ P @ h + CALIBRATING.bearing_std**2 + bent)
    np.testing.assert_allclose(own.state - before, gain * innovation, atol=1e-8)
    np.testing.assert_allclose(own.covariance, P - np.outer(gain, h @ P), atol=1e-8)


def test_the_linearisation_error_of_a_bearing_is_as_drawn():
    """Monte Carlo: the spread of bearings about their linearisation, for ends as uncertain as a third of the line."""
    d, P = np.array([2.0, 1.0]), np.array([[0.5, 0.2], [0.2, 0.3]])
    e = np.random.default_rng(1).multivariate_normal(np.zeros(2), P / 4, 400_000)
    square = float(d @ d)
    bearing = np.arctan2(d[1] + e[:, 1], d[0] + e[:, 0]) - math.atan2(d[1], d[0])
    rest = bearing - (e[:, 1] * d[0] - e[:, 0] * d[1]) / square
    assert left_out(*d, square, P / 4) == pytest.approx(np.var(rest), rel=0.25)


@pytest.mark.parametrize("std", [0.1, 0.8, 2.0])
def test_a_path_with_an_uncertain_heading_is_as_drawn(std):
    heading = std * np.random.default_rng(2).standard_normal(400_000)
    shrunk, along, across = unsure(std**2)
    assert np.cos(heading).mean() == pytest.approx(shrunk, abs=0.005)
    assert np.cos(heading).std() == pytest.approx(along, abs=0.005)
    linear = np.polyfit(heading, np.sin(heading), 1)
    assert linear[0] == pytest.approx(shrunk, abs=0.005)
    assert np.std(np.sin(heading) - np.polyval(linear, heading)) == pytest.approx(across, abs=0.005)


def test_how_much_of_the_wheels_applies_is_learnt():
    """A robot that turns evenly and at once, where the filter expects the gains of another kind."""
    rng = np.random.default_rng(4)
    wheels = replace(IROBOT_CREATE, delay=(0.0,), share=(1.0,))
    mean, std = (0.936, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0), (0.25, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 0.5, 0.0)
    quiet = replace(CALIBRATING, turn_noise=(0.001, 0.03, 0.03), walk=(0.0,) * 9, jitter=0.0)
    tuning = replace(quiet, wheels=wheels, mean=mean, std=std)
    own, heading = PlanarFilter(tuning, np.zeros(3), np.diag([1e-4, 1e-4, 1e-4])), 0.0
    far = 1000 * math.cos(1.0), 1000 * math.sin(1.0)  # so that only the heading counts
    for k, w in enumerate(np.repeat(rng.choice([-0.4, -0.03, 0.0, 0.03, 0.4], 600), 10)):
        own.advance(DT, w * DT, 0.07 * DT)
        heading += 0.9 * w * DT
        if k % 10 == 9:
            own.landmark(1.0 - heading + 0.01 * rng.standard_normal(), *far)
    share, spread = float(own.state[SHARE]), math.sqrt(own.covariance[SHARE, SHARE])
    assert spread < 0.3 and abs(share) < 3 * spread and share < 0.5
    assert own.state[TURN_SCALE] == pytest.approx(0.9, abs=0.06)


def test_fusing_the_same_news_again_never_claims_more_than_either_alone():
    tuning = replace(CALIBRATING, dependent=1.0)
    own = PlanarFilter(tuning, np.zeros(3), np.diag([0.04, 0.04, 1e-4]))
    theirs = np.diag([0.04, 0.04, 1e-4])
    calibration = own.covariance[TURN_SCALE, TURN_SCALE]
    for _ in range(200):
        own.robot(math.atan2(1, 2), PlanarPose(np.array([2.0, 1.0, 0.0]), theirs))
    line = np.array([-1, 2]) / math.sqrt(5)
    assert line @ own.covariance[:2, :2] @ line > 0.5 * 0.04
    assert own.covariance[TURN_SCALE, TURN_SCALE] == pytest.approx(calibration)  # its own business


def test_intersection_grows_only_where_something_is_gained():
    assert growth(own=1e-6, gain=1e-12, cost=1e-3, theirs=1.0, noise=1e-3, dependent=1.0) == (0.0, 0.0)
    ours, theirs = growth(own=1.0, gain=1.0, cost=1.0, theirs=1e-6, noise=1e-6, dependent=1.0)
    assert min(ours, theirs) > 1.0
    assert growth(own=1.0, gain=1.0, cost=1.0, theirs=1e-6, noise=1e-6, dependent=0.0) == (1.0, 1.0)


def test_outliers_are_dropped_and_doubtful_ones_count_less():
    def after(innovation):
        own = PlanarFilter(CALIBRATING, np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]))
        own.landmark(innovation, 2.0, 0.0)
        return own

    small, large, absurd = after(0.02), after(0.09), after(0.9)
    assert abs(absurd.state[HEADING]) < abs(small.state[HEADING])
    assert large.state[HEADING] != 0.0
    assert abs(large.state[HEADING]) < 4.5 * abs(small.state[HEADING])
    assert large.covariance[HEADING, HEADING] > small.covariance[HEADING, HEADING]


def test_calibrates_scale_lead_and_camera_bias():
    """A robot that turns 0.85 times its command, 0.25 s late, with its camera off by 0.015 rad."""
    rng = np.random.default_rng(3)
    scale, lead, bias, noise = 0.85, 0.25, 0.015, 0.02
    mean = (0.94, 1.0, 0.0, 0.0, 0.0, 0.15, 0.0, 1.0, 0.0)
    std = (0.08, 0.03, 1e-6, 1e-6, 1e-6, 0.08, 0.02, 0.0, 0.0)
    tuning = replace(CALIBRATING, wheels=Wheels(), mean=mean, std=std, bearing_std=noise, jitter=0.0)
    own = PlanarFilter(tuning, np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]))
    posts = [np.array([4 * math.cos(a), 4 * math.sin(a)]) for a in np.arange(6)]
    commands = np.repeat(rng.choice([-0.4, 0.0, 0.4], 300), 20)  # for a second each
    x, y, heading, late = 0.0, 0.0, 0.0, round(lead / DT)
    for k, w in enumerate(commands):
        own.advance(DT, w * DT, 0.07 * DT)
        v = 0.07 if k >= late else 0.0
        turn = scale * DT * (commands[k - late] if k >= late else 0.0)
        x, y = x + v * DT * math.cos(heading + turn / 2), y + v * DT * math.sin(heading + turn / 2)
        heading += turn
        if k % 10 == 0:
            post = posts[rng.integers(6)]
            own.landmark(math.atan2(post[1] - y, post[0] - x) - heading + bias + noise * rng.standard_normal(), *post)
    error = own.state[[TURN_SCALE, LEAD, BIAS]] - [scale, lead, bias]
    spread = np.sqrt(np.diag(own.covariance))[[TURN_SCALE, LEAD, BIAS]]
    assert (np.abs(error) < 3.5 * spread).all()
    assert (spread < np.array([0.015, 0.01, 0.01])).all()
    assert math.hypot(own.state[X] - x, own.state[Y] - y) < 0.1


def test_textbook_filter_has_no_calibration_to_estimate():
    own = PlanarFilter(TEXTBOOK, np.zeros(3), np.diag([0.01, 0.01, 0.01]))
    own.advance(DT, 0.02, 0.05)
    own.landmark(0.1, 2.0, 0.3)
    np.testing.assert_array_equal(own.state[3:], TEXTBOOK.mean)
    assert own.level.factor == 1.0
    assert np.abs(own.state[:3]).max() > 0


# Mixtures


ONE_KIND = replace(CALIBRATING, drifting=(0.0, 0.0))
POSTS = ((3.0, 0.0), (0.0, 3.0), (-2.0, -2.0))


def test_parts_have_nearly_the_mean_and_the_covariance_of_the_whole():
    own = Mixture(ONE_KIND, np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.09, 0.8**2]))
    own.filters[0].covariance[HEADING, TURN_SCALE] = own.filters[0].covariance[TURN_SCALE, HEADING] = 0.15
    state, covariance = own.state.copy(), own.covariance.copy()
    own.split()
    assert len(own.filters) == 3
    np.testing.assert_allclose(own.state, state, atol=1e-9)
    scale = np.sqrt(np.outer(covariance.diagonal(), covariance.diagonal())) + 1e-12
    np.testing.assert_allclose(own.covariance / scale, covariance / scale, atol=0.06)
    scales = [one.state[TURN_SCALE] for one in own.filters]
    assert scales[0] < scales[1] < scales[2]  # each with the wheels that led there


@pytest.mark.parametrize("heading", [-2.0, 0.3, 2.5])
def test_bearings_decide_between_headings(heading):
    """Start with any heading; the odometry tells a path, the camera four landmark bearings a second."""
    rng = np.random.default_rng(5)
    own = Mixture(ONE_KIND, np.zeros(3), np.diag([0.01, 0.01, 2.0**2]))
    x, y = 0.0, 0.0
    for k in range(200):
        own.advance(DT, 0.0, 0.1 * DT)
        own.split()
        if k > 8:  # by then it drives
            x, y = x + 0.1 * DT * math.cos(heading), y + 0.1 * DT * math.sin(heading)
        if k % 5 == 0:
            px, py = POSTS[k // 5 % 3]
            bearing = math.atan2(py - y, px - x) - heading + 0.02 * rng.standard_normal()
            own.landmark((bearing + math.pi) % (2 * math.pi) - math.pi, px, py)
    assert len(own.filters) == 1
    assert abs((own.state[HEADING] - heading + math.pi) % (2 * math.pi) - math.pi) < 0.1
    assert math.hypot(own.state[X] - x, own.state[Y] - y) < 0.15


@pytest.mark.parametrize("drift", [0.0, 0.02])
def test_the_kind_of_odometry_is_found_out(drift):
    rng = np.random.default_rng(6)
    own, heading = Mixture(CALIBRATING, np.zeros(3), np.diag([1e-4, 1e-4, 1e-4])), 0.0
    for k in range(4000):
        own.advance(DT, 0.0, 0.0)
        heading += drift * DT
        if k % 5 == 0:
            own.landmark(
                (1.0 - heading + 0.02 * rng.standard_normal() + math.pi) % (2 * math.pi) - math.pi, 540.0, 841.0
            )
    assert len(own.filters) == 1
    assert own.state[DRIFT] == pytest.approx(drift, abs=0.003)
