"""Random numbers in the kernels, and the quality of an estimate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.base.errors import ScenarioError
from coopenv.estimation import Sight, metrics, poses
from coopenv.estimation.poses import left_covariance
from coopenv.scenario import load_scenario
from coopenv.world import quality, random
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES, Calls
from tests.oracles.geometry import OPTICAL_TO_BODY_FORWARD as FORWARD

LARGEST = 2**32 - 1
call = Calls(
    __name__,
    {random.uniform: "u 1 > 1"},
    {
        random.philox: "u4 u u > u4",
        random.random_words: "U u i i u > u4",
        random.gaussian_pair: "u u 1 > 1 1",
        random.unit_vector: "u u 3 > 3",
    },
)
ONE = [1.0]
KNOWN_ANSWERS = (
    ((0, 0, 0, 0), (0, 0), (0x5F6FB709, 0x0D893F64, 0x4F121F81, 0x4F730A48)),
    (4 * (LARGEST,), 2 * (LARGEST,), (0x5207DDC2, 0x45165E59, 0x4D8EE751, 0x8C52F662)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0x4DFCCABA, 0x190A87F0, 0xC47362BA, 0xB6B5242A),
    ),
)
"""Random123's known-answer vectors of philox4x32-7: (counter, key, output)."""


def draws(counters: ArrayLike, keys: ArrayLike) -> np.ndarray:
    key0, key1 = np.asarray(keys, np.uint32).T
    return call(random.philox, "float64", np.asarray(counters, np.uint32), key0, key1)


def gaussian_pairs(dtype: str, words: np.ndarray) -> np.ndarray:
    return np.column_stack(call(random.gaussian_pair, dtype, *words.astype(np.uint32).T, ONE))


def test_known_answers() -> None:
    counters, keys, expected = zip(*KNOWN_ANSWERS, strict=True)
    np.testing.assert_array_equal(draws(counters, keys), np.array(expected, dtype=np.uint32))


def test_draw_packs_what_it_depends_on() -> None:
    seed = np.array([0, 5, 2**63 + 12345, 2**64 - 1], dtype=np.uint64)
    episode, index = np.array([0, 1, 7, LARGEST]), np.array([0, 1, 36000, 2**31 - 1])
    subject, stream = np.array([0, 3, 65536 * 4 + 7, 1]), np.array([1, 2, 3, 7])
    given = ((episode, "u4"), (index, "i4"), (subject, "i4"), (stream, "u4"))
    counters = np.column_stack([index, subject, stream, episode])
    keys = np.column_stack([seed & np.uint64(LARGEST), seed >> np.uint64(32)])
    np.testing.assert_array_equal(
        call(random.random_words, "float64", seed, *(x.astype(t) for x, t in given)),
        draws(counters, keys),
    )


def words(count: int, columns: int = 4) -> np.ndarray:
    """Return consecutive draws of one stream, as the world takes them tick by tick."""
    counters = np.zeros((count, 4), dtype=np.uint32)
    counters[:, 0], counters[:, 2] = np.arange(count), 6
    return draws(counters, [(11, 0)])[:, :columns]


@pytest.mark.parametrize("dtype", DTYPES)
def test_uniform_stays_inside_the_open_interval(dtype: str) -> None:
    edges = np.array([0, 1, 2, 2**31, LARGEST - 200, LARGEST - 128, LARGEST - 1, LARGEST])
    u = call(random.uniform, dtype, edges.astype(np.uint32), ONE)
    assert (u > 0.0).all()
    assert (u < 1.0).all()


def test_uniform_is_uniform() -> None:
    u = call(random.uniform, "float64", words(50000).ravel().astype(np.uint32), ONE)
    assert stats.kstest(u, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 0.01


def test_gaussian_pairs_are_independent_standard_normals() -> None:
    pairs = gaussian_pairs("float64", words(100000, 2))
    for column in pairs.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
        assert abs(stats.kurtosis(column)) < 0.05
    x, y = pairs.T
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.013
    assert abs(np.corrcoef(x**2, y**2)[0, 1]) < 0.013
    assert stats.kstest(np.arctan2(y, x) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert np.abs(pairs).max() > 4.0


def test_gaussian_is_finite_at_the_extremes() -> None:
    ends = np.array([[a, b] for a in (0, 1, LARGEST - 1, LARGEST) for b in (0, 1, 2, 3, LARGEST)])
    assert np.isfinite(gaussian_pairs("float64", ends)).all()


def test_directions_are_uniform_on_the_sphere() -> None:
    u = call(random.unit_vector, "float64", *words(50000, 2).T.astype(np.uint32), np.zeros((1, 3)))
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, atol=1e-6)
    for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, 0.8]):  # Archimedes: each height is uniform
        assert stats.kstest((u @ axis + 1) / 2, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(u.T @ u / len(u), np.eye(3) / 3, atol=0.01)


COUNT = 300


@wp.func
def log_determinant(P: Any):
    I11, _L21, I22 = quality.cholesky_of(P)
    return quality.log_determinant(I11, I22)


@wp.func
def judged(P: Any, R: Any, position: Any, R_hat: Any, p_hat: Any):
    """Return the observer's error coordinates and the NEES."""
    I11, L21, I22 = quality.cholesky_of(P)
    e1, e2 = quality.observer_error(R, position, R_hat, p_hat, quality.RICCATI)
    return e1, e2, quality.normalised_error_squared(I11, L21, I22, e1, e2)


@wp.func
def nees_of_left(P: Any, R: Any, position: Any, R_hat: Any, p_hat: Any):
    I11, L21, I22 = quality.cholesky_of(P)
    e1, e2 = quality.observer_error(R, position, R_hat, p_hat, quality.LEFT)
    return quality.normalised_error_squared(I11, L21, I22, e1, e2)


@wp.func
def nees_of_right(P: Any, R: Any, position: Any, R_hat: Any, p_hat: Any):
    I11, L21, I22 = quality.cholesky_of(P)
    e1, e2 = quality.observer_error(R, position, R_hat, p_hat, quality.RIGHT)
    return quality.normalised_error_squared(I11, L21, I22, e1, e2)


of_quality = Calls(
    __name__,
    {
        log_determinant: "66 > 1",
        judged: "66 33 3 33 3 > 3 3 1",
        nees_of_left: "66 33 3 33 3 > 1",
        nees_of_right: "66 33 3 33 3 > 1",
        quality.position_variance: "66 3 > 1",
    },
)


def covariances(rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(size=(COUNT, 6, 6))
    scale = 10.0 ** rng.uniform(-2, 1, (COUNT, 6, 1))
    P = (A @ np.swapaxes(A, 1, 2) + 0.3 * np.eye(6)) * scale * np.swapaxes(scale, 1, 2)
    return (P + np.swapaxes(P, 1, 2)) / 2


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-11), ("float32", 2e-3)])
def test_log_determinant(dtype: str, tolerance: float) -> None:
    P = covariances(np.random.default_rng(0))
    sign, expected = np.linalg.slogdet(P)
    assert (sign > 0).all()
    assert_allclose(of_quality(log_determinant, dtype, P), expected, atol=tolerance)


def test_log_determinant_in_ten_decades() -> None:
    P = np.diag(np.logspace(-8, 2, 6))[None]
    assert_allclose(of_quality(log_determinant, "float64", P), np.log(np.logspace(-8, 2, 6)).sum(), rtol=1e-13)


def drawn_poses(seed: int, angle: float | None) -> tuple[np.ndarray, ...]:
    """Return truth and estimate: R, pbar, Rhat, phat, the error turned by `angle` (None: any) about random axes."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(COUNT, rng).as_matrix()
    axis = rng.normal(size=(COUNT, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    size = rng.uniform(0, np.pi - 1e-3, (COUNT, 1)) if angle is None else angle
    R_hat = R @ Rotation.from_rotvec(-size * axis).as_matrix()  # Rtilde = Rhat^T R = Rot(size axis)
    position = rng.uniform(-20, 20, (COUNT, 3))
    estimate = position + rng.normal(size=(COUNT, 3))
    return R, position, R_hat, np.einsum("nji,nj->ni", R_hat, estimate)


@pytest.mark.parametrize("angle", [None, 1e-9, 1e-3, np.pi - 1e-6])
def test_error_coordinates_and_nees(angle: float | None) -> None:
    R, position, R_hat, p_hat = drawn_poses(1, angle)
    P = covariances(np.random.default_rng(2))
    e1, e2, value = of_quality(judged, "float64", P, R, position, R_hat, p_hat)
    estimate = np.einsum("nij,nj->ni", R_hat, p_hat)
    expected = poses.Coordinates.RICCATI.error(R, position, R_hat, estimate)
    assert_allclose(np.concatenate([e1, e2], axis=1), expected, atol=1e-13)
    assert_allclose(value, metrics.nees(expected, P), rtol=1e-8)


@pytest.mark.parametrize("away", [0.0, 1e3])
@pytest.mark.parametrize("angle", [None, 1e-9, 1e-3, np.pi - 1e-6])
@pytest.mark.parametrize(
    ("nees", "coordinates"), [(nees_of_left, poses.Coordinates.LEFT), (nees_of_right, poses.Coordinates.RIGHT)]
)
def test_nees_of_other_coordinates_is_that_of_the_observer_anywhere(
    nees: Any, coordinates: poses.Coordinates, angle: float | None, away: float
) -> None:
    """Although the covariance is kept in the paper's, as far as their first order goes."""
    R, position, R_hat, p_hat = drawn_poses(1, angle)
    position = position + away
    estimate = np.einsum("nij,nj->ni", R_hat, p_hat) + away
    P = covariances(np.random.default_rng(2))
    kept = [poses.riccati_covariance(coordinates, *row) for row in zip(R_hat, estimate, P, strict=True)]
    expected = metrics.nees(coordinates.error(R, position, R_hat, estimate), P)
    arguments = np.array(kept), R, position, R_hat, np.einsum("nji,nj->ni", R_hat, estimate)
    assert_allclose(of_quality(nees, "float64", *arguments), expected, rtol=0.01 if away else 2e-6)


def test_nees_of_a_diagonal_covariance() -> None:
    """10 degrees too far about z at the origin, and 0.3 m off in y."""
    turn = Rotation.from_euler("z", np.radians(10)).as_matrix()
    P = np.diag([1.0, 1.0, 0.01, 1.0, 0.09, 1.0])
    truth, estimate = (np.eye(3)[None], np.zeros((1, 3))), (turn[None], [[0.0, -0.3, 0.0]])
    e1, e2, value = of_quality(judged, "float64", P[None], *truth, *estimate)
    lam = -2 * np.sin(np.radians(5))
    assert_allclose(e1[0], [0, 0, lam], atol=1e-14)
    assert_allclose(e2[0], [0, 0.3, 0], atol=1e-14)
    assert_allclose(value[0], lam**2 / 0.01 + 1.0, rtol=1e-13)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-4)])
def test_position_variance_is_that_of_left_coordinates_at_any_attitude(dtype: str, tolerance: float) -> None:
    rng = np.random.default_rng(7)
    P, p_hat = covariances(rng), rng.uniform(-20, 20, (COUNT, 3))
    expected = [np.trace(left_covariance(p, covariance)[3:, 3:]) for p, covariance in zip(p_hat, P, strict=True)]
    assert_allclose(of_quality(quality.position_variance, dtype, P, p_hat), expected, rtol=tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
def test_nothing_is_wrong_with_a_perfect_estimate(dtype: str) -> None:
    R, position, _, _ = drawn_poses(5, None)
    R = R.astype(dtype).astype(float)
    p = np.einsum("nji,nj->ni", R, position)
    e1, e2, value = of_quality(judged, dtype, covariances(np.random.default_rng(6)), R, position, R, p)
    tolerance = 1e-13 if dtype == "float64" else 2e-5
    assert np.abs(e1).max() < tolerance
    assert np.abs(e2).max() < tolerance
    assert (value >= 0.0).all()


# The sliding Gramian: what was seen over the last metres, however long they took


SEEN = {"camera.range": 30.0, "camera.miss_probability": 0.0, "topology.acyclic": True, "obstacles": []}


def engine_of(**changes: object) -> Engine:
    names = {key.replace("__", "."): value for key, value in changes.items()}
    engine = Engine(load_scenario(FOUR_WAY, {**SEEN, **names}), 1, "float64")
    engine.reset([0])
    return engine


def expected(samples: list[tuple[float, float, np.ndarray]], length: float) -> float:
    """Return the smallest eigenvalue of samples (way before, way behind, C^T C), in ten blocks of a window."""
    block = length / 10
    newest = int(samples[-1][1] / block)
    kept = [(end - begin, G) for begin, end, G in samples if int(end / block) > newest - 10]
    return float(np.linalg.eigvalsh(sum(w * G for w, G in kept) / sum(w for w, _ in kept))[0])


def test_the_windowed_gramian_is_the_mean_over_the_last_metres() -> None:
    engine = engine_of(observer__gramian_distance=1.0)
    landmarks = engine.world.model.landmarks
    rng, samples, way = np.random.default_rng(0), [], 0.0
    compared = 0
    for tick in range(1, 241):
        engine.step(np.array([[[rng.uniform(-1, 1), 0.2]] * 4]) if tick % 6 == 1 else None, ticks=1)
        if tick % 3:
            continue
        now = float(engine.view("distance_driven")[0, 0])
        if now > way:
            R = engine.view("estimate_rotation")[0, 0]
            G = np.zeros((6, 6))
            for n in np.flatnonzero(engine.view("sight")[0, 0, :landmarks] == Sight.VISIBLE):
                b = R @ FORWARD @ engine.view("bearing")[0, 0, n]
                z = engine.view("position")[0, n]
                cross = np.array([[0, -z[2], z[1]], [z[2], 0, -z[0]], [-z[1], z[0], 0]])
                C = (np.eye(3) - np.outer(b, b)) @ np.hstack([-cross, np.eye(3)])
                G += C.T @ C
            samples.append((way, now, G))
            way = now
        if samples:
            engine.refresh()
            compared += 1
            found = engine.view("gramian_min_eigenvalue")[0, 0]
            assert found == pytest.approx(expected(samples, 1.0), rel=1e-6, abs=1e-9)
    assert way > 1.5 and compared > 60


def test_standing_neither_adds_nor_forgets() -> None:
    engine = engine_of(observer__gramian_distance=1.0, noise__enabled=False)
    for _ in range(20):
        engine.step(np.array([[[1.0, 0.0]] * 4]))
    for _ in range(15):  # the speed fades
        engine.step(np.array([[[-1.0, 0.0]] * 4]))
    before = engine.view("gramian_min_eigenvalue").copy()
    for _ in range(20):
        engine.step(np.array([[[-1.0, 0.0]] * 4]))
    assert (before > 0).any()
    np.testing.assert_allclose(engine.view("gramian_min_eigenvalue"), before, rtol=1e-4)


def test_a_fast_vehicle_forgets_the_blocks_that_it_skips() -> None:
    """Information lasts for the window at most, though a sample is longer than a block."""
    engine = engine_of(observer__gramian_distance=0.1)  # blocks of 1 cm, samples of up to 5 cm
    for _ in range(20):
        engine.step(np.array([[[1.0, 0.0]] * 4]))
    kept = engine.view("gramian_time")[0].sum(axis=-1)
    assert (kept > 0.04).all() and (kept < 0.16).all()


def test_a_distance_is_positive() -> None:
    with pytest.raises(ScenarioError, match=r"observer\.gramian_distance: "):
        load_scenario(FOUR_WAY, {"observer.gramian_distance": 0.0})
