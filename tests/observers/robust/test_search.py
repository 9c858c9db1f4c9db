"""Vehicles that are lost: they search, find themselves, and say nothing meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.robust.scenes import all_lost
from benchmarks.robust.studies import search
from coopenv.estimation.poses import exp_so3
from coopenv.scenario import load_scenario
from tests.helpers.env_suite import rest_slow
from tests.helpers.robust_ticks import (
    LANDMARKS,
    NOISE,
    OpenRobust,
    Pose,
    direction,
    displaced,
    left_error,
    measured,
    pose_of,
    started,
    tick,
)


@pytest.mark.parametrize("name", ["lane:6", "random:9,seed=2"])
def test_all_vehicles_find_their_places(name: str) -> None:
    found = search(all_lost(name, 24.0), range(8), 24.0)
    assert np.isfinite(found.settled).all()
    assert found.wrong.mean() < 0.005
    assert (found.nees.mean(axis=0) < 2.0).all()


def test_all_vehicles_find_their_places_in_the_paper_s_scene() -> None:
    """The fifth vehicle's solutions nearly meet until 17 s: it follows them, and is near long before they part."""
    found = search(load_scenario("busy_intersection", {"observer.name": "robust", "horizon": 25.0}), range(16), 24.0)
    assert np.isfinite(found.settled).all() and not found.wrong.any()
    assert np.median(found.settled[:, 4]) < 14.0


NOWHERE = np.diag([1.8] * 3 + [900.0] * 3)
PATH = exp_so3(np.array([0.0, 0.0, 0.01])), np.array([0.03, 0.002, 0.0])
TRIPLES = [(0, 1, 2), (0, 2, 3), (1, 3, 4), (0, 1, 4)]


def lost(rng: np.random.Generator) -> tuple[Pose, OpenRobust]:
    """Return a pose, and an observer that knows nothing of it."""
    truth = displaced((np.eye(3), np.zeros(3)), np.concatenate([rng.normal(size=3), rng.uniform(-1.5, 1.5, 3)]))
    return truth, started(displaced(truth, 2.0 * rng.normal(size=6)), NOWHERE)


def every_pose(bearings: dict[int, np.ndarray], rng: np.random.Generator) -> list[Pose]:
    """Return every pose that fits the bearings, as least squares from many starts find them."""
    found: list[Pose] = []
    for _ in range(60):
        start = (Rotation.random(None, rng).as_matrix(), rng.uniform(-12.0, 12.0, 3))

        def residuals(e: np.ndarray, start: Pose = start) -> np.ndarray:
            return np.concatenate([direction(displaced(start, e), LANDMARKS[n]) - b for n, b in bearings.items()])

        best = least_squares(residuals, np.zeros(6), method="lm", max_nfev=400)
        pose = displaced(start, best.x)
        if best.cost < 1e-16 and all(np.linalg.norm(left_error(other, pose)) > 1e-3 for other in found):
            found.append(pose)
    return found


@pytest.mark.parametrize(("targets", "led"), [((1,), False), ((1, 2, 3), True)])
def test_one_source_alone_does_not_show_that_a_vehicle_is_lost(targets: tuple[int, ...], led: bool) -> None:
    """Bearings of a pose 0.6 m aside: either the vehicle is there, or its targets stand as much aside."""
    known, shown = (np.eye(3), np.zeros(3)), displaced((np.eye(3), np.zeros(3)), np.array([0, 0, 0, 0, 0.6, 0.0]))
    observer = started(known, np.diag([1e-3] * 3 + [1e-2] * 3) ** 2)
    for k in range(1, 181):
        observer.update(tick(observer, k, bearings={n: direction(shown, LANDMARKS[n]) for n in targets}))
    moved = np.linalg.norm(pose_of(observer)[1])
    assert (moved > 0.3) == led and (led or moved < 0.1)


@pytest.mark.parametrize("triple", rest_slow([(triple,) for triple in TRIPLES], 2))
def test_every_pose_that_fits_three_bearings_is_followed(triple: tuple[int, int, int]) -> None:
    """A vehicle stands still. Of solutions that are followed each is one of SciPy's, and each of those is followed."""
    rng = np.random.default_rng(sum(triple))
    truth, observer = lost(rng)
    bearings = {n: direction(truth, LANDMARKS[n]) for n in triple}
    for k in range(1, 200):
        observer.update(tick(observer, k, bearings=bearings))
        if observer.memory.search["hypotheses"] or not observer.memory.search["active"]:
            break
    poses = every_pose(bearings, rng)
    assert any(np.linalg.norm(left_error(truth, pose)) < 1e-3 for pose in poses)
    count = int(observer.memory.search["hypotheses"])
    followed = [(h["R"], h["p"]) for h in observer.memory.hypothesis["estimate"]["pose"][:count]]
    for pose in poses:
        assert min(np.linalg.norm(left_error(pose, other)) for other in followed) < 0.05
    for other in followed:
        assert min(np.linalg.norm(left_error(pose, other)) for pose in poses) < 0.05


def found_after(truth: Pose, observer: OpenRobust, rng: np.random.Generator, seen: tuple[int, ...]) -> tuple[Pose, int]:
    """Drive until the pose is found, for ten seconds at most; return where the vehicle is then, and the tick."""
    for k in range(1, 600):
        truth = truth[0] @ PATH[0], truth[1] + truth[0] @ PATH[1]
        bearings = {n: measured(truth, LANDMARKS[n], rng) for n in seen}
        observer.update(tick(observer, k, PATH, bearings))
        if not observer.memory.search["active"]:
            return truth, k
    return truth, 600


def test_errors_of_the_pose_that_is_found_match_its_covariance() -> None:
    """Over 60 vehicles that see four landmarks: NEES is of six numbers."""
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth, observer = lost(rng)
        truth, ticks = found_after(truth, observer, rng, (0, 1, 2, 4))
        assert ticks < 600
        e = left_error(pose_of(observer), truth)
        nees.append(e @ np.linalg.solve(observer.P[:6, :6], e))
    # the standard error of a mean of chi-squares of six is sqrt(12 / 60); frames of a search count as noisier
    assert 2.0 < np.mean(nees) < 6.0 + 3.0 * np.sqrt(12.0 / 60.0), np.mean(nees)


def test_two_landmarks_are_too_few() -> None:
    rng = np.random.default_rng(0)
    truth, observer = lost(rng)
    assert found_after(truth, observer, rng, (0, 1))[1] == 600
    assert observer.memory.search["hypotheses"] == 0
    assert observer.message().position is None


def test_bearings_to_the_wrong_landmarks_end_in_no_pose() -> None:
    rng = np.random.default_rng(0)
    truth, observer = lost(rng)
    for k in range(1, 120):
        order = rng.permutation(4)
        observer.update(tick(observer, k, bearings={n: direction(truth, LANDMARKS[order[n]]) for n in range(4)}))
        assert observer.memory.search["active"]


def driven(truth: Pose, observer: OpenRobust, rng: np.random.Generator, ticks: range) -> Pose:
    """Drive with two landmarks in view at a time; return where the vehicle is then."""
    for k in ticks:
        truth = truth[0] @ PATH[0], truth[1] + truth[0] @ PATH[1]
        seen = ((0, 1), (2, 3), (1, 4))[k // 10 % 3]
        observer.update(tick(observer, k, PATH, {n: measured(truth, LANDMARKS[n], rng) for n in seen}))
    return truth


def is_near(observer: OpenRobust, truth: Pose) -> bool:
    e = left_error(pose_of(observer), truth)
    return bool(np.linalg.norm(e[:3]) < 0.02 and np.linalg.norm(e[3:]) < 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_wide_start_converges_with_two_landmarks_in_a_frame(seed: int) -> None:
    """Deviations of 25 deg and 0.7 m; no frame has the three bearings that P3P needs."""
    rng = np.random.default_rng(seed)
    truth, std = (np.eye(3), np.zeros(3)), np.repeat([0.44, 0.7], 3)
    observer = started(displaced(truth, std * rng.normal(size=6)), np.diag(std**2))
    assert observer.message().position is None
    truth = driven(truth, observer, rng, range(1, 480))
    assert is_near(observer, truth) and observer.message().position is not None


def test_a_loss_ends_with_two_landmarks_in_a_frame() -> None:
    """After 3 s the vehicle is turned by 40 deg and moved by 1.5 m, which its odometry does not show."""
    rng = np.random.default_rng(0)
    truth = (np.eye(3), np.zeros(3))
    observer = started(truth, np.diag(np.repeat([0.01, 0.05], 3) ** 2))
    truth = driven(truth, observer, rng, range(1, 180))
    assert is_near(observer, truth)
    truth = displaced(truth, np.array([0.0, 0.0, 0.7, 1.2, 0.9, 0.0]))
    truth = driven(truth, observer, rng, range(180, 181))
    assert not is_near(observer, truth)
    truth = driven(truth, observer, rng, range(181, 180 + 15 * 60))
    assert is_near(observer, truth) and observer.message().position is not None


@pytest.mark.parametrize(("angle", "length", "known"), [(0.1, 1.0, True), (0.5, 1.0, False), (0.1, 3.0, False)])
def test_known_means_small_enough_to_linearise(angle: float, length: float, known: bool) -> None:
    """One axis that is too uncertain is one too many; who is not known says nothing."""
    P = np.diag([0.1**2, 0.1**2, angle**2, 1.0, 1.0, length**2])
    observer = started((np.eye(3), np.zeros(3)), P, noise=NOISE)
    assert (observer.message().position is not None) == known
    assert bool(observer.memory.search["active"]) != known
