"""The Cramer-Rao bound against closed forms, a batch least squares, finite differences and reference figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.observers import Coordinates, Recording, SensorNoise
from coopenv.observers.bound import ancestors, cramer_rao, cramer_rao_ancestors, error_states, information, steps
from coopenv.observers.contract import MIN_BEARING_STD
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.oracles.batch import assert_same_covariance, small_errors, small_record, small_solution


def transitions(made: Recording) -> np.ndarray:
    return np.array([block_diag(*each) for each in steps(made, range(made.ticks))])


def test_joint_bound_is_the_batch_solution_s_covariance() -> None:
    made = small_record(3)
    _, _, covariance = small_solution(3)
    assert_same_covariance(cramer_rao(made).covariance[-1], covariance)


def test_alone_and_with_others() -> None:
    """Vehicle 1 knows its neighbours: alone it is bounded by its own batch, and its followers can only help."""
    made = small_record(3)
    _, _, covariance = small_solution(3, (0,))
    alone, joint = cramer_rao(made, joint=False), cramer_rao(made)
    assert_allclose(alone.position[-1, 0], np.sqrt(np.trace(covariance[0, 3:, 3:])), rtol=1e-3)
    assert (joint.position[1:, 0] < alone.position[1:, 0]).all()
    assert (joint.position[1:, 4] > alone.position[1:, 4]).all()  # vehicle 5 sees vehicles only


def test_a_known_motion_adds_up_information() -> None:
    """Without odometry noise J grows by each frame's information carried back to the start."""
    scenario = small_errors(
        {"horizon": 0.1, "noise.velocity": 0.0, "noise.angular_velocity": 0.0, "noise.bearing.scale": 0.01}
    )
    made = record(scenario, 0)
    M, F = information(made, True, range(5), range(made.ticks)), transitions(made)
    J = np.zeros((30, 30))
    for i in range(5):
        J[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.linalg.inv(made.start_covariance[i])
    Phi = np.eye(30)
    for k in range(1, made.ticks):
        Phi = F[k] @ Phi
        J = J + Phi.T @ M[k] @ Phi
    P = Phi @ np.linalg.inv(J) @ Phi.T
    assert_allclose(cramer_rao(made).position[-1, 3] ** 2, np.trace(P[21:24, 21:24]), rtol=1e-8)


def test_transition_carries_small_errors() -> None:
    """A start that is off by e and moves as the truth does is off by F e later."""
    made = record(small_errors({"horizon": 0.1}), 0)
    R, p = made.truth.rotation[:, 1], made.truth.position[:, 1]
    e = 1e-5 * np.arange(1.0, 7.0)
    wrong_R, wrong_p = R[0] @ Rotation.from_rotvec(-e[:3]).as_matrix(), p[0] - R[0] @ e[3:]
    F = transitions(made)
    for k in range(1, made.ticks):
        wrong_p = wrong_p + wrong_R @ R[k - 1].T @ (p[k] - p[k - 1])
        wrong_R = wrong_R @ R[k - 1].T @ R[k]
        e = F[k, 6:12, 6:12] @ e
        assert_allclose(Coordinates.LEFT.error(R[k], p[k], wrong_R, wrong_p), e, atol=1e-8)


def test_only_what_was_seen_counts() -> None:
    made = record(small_errors({"horizon": 0.5, "noise.bearing.scale": 0.003}), 0)
    blind = replace(made, visible=np.zeros_like(made.visible))
    free = cramer_rao(blind)
    noise = made.setups[0].noise.odometry(made.dt)
    assert_allclose(information(blind, True, range(5), range(made.ticks)), 0.0)
    angle = np.trace(free.covariance[-1, 0, :3, :3])
    assert_allclose(angle, np.trace(made.start_covariance[0, :3, :3]) + 30 * noise[:3].sum(), rtol=1e-9)
    assert (cramer_rao(made).position[-1] < free.position[-1]).all()


def test_reference_figures() -> None:
    """Busy intersection, 2.89 mrad, 0.1 m/s and 0.01 rad/s per sample at 60 Hz: computed elsewhere before."""
    scenario = small_errors(
        {
            "noise.bearing.scale": 0.005 / np.sqrt(3),
            "noise.bearing.rate": "sample",
            "noise.odometry_rate": "sample",
            "rates.odometry": 60.0,
        },
        size=0.2,
        turning=False,
    )
    whole = cramer_rao(record(scenario, 0))
    bound = np.sqrt(np.mean(whole.position[whole.t >= 30.0] ** 2, axis=0))
    assert_allclose(bound, [0.0116, 0.0110, 0.0136, 0.0129, 0.0238], rtol=0.03)


def test_ancestors_know_what_reaches_them() -> None:
    """Vehicle 1 has no leader: its batch alone. The last one hears, through others, of everybody."""
    made = small_record(3)
    family = cramer_rao_ancestors(made)
    joint, alone = cramer_rao(made), cramer_rao(made, joint=False)
    assert_allclose(family.covariance[:, 0], alone.covariance[:, 0], rtol=1e-9, atol=1e-15)
    assert_allclose(family.covariance[:, 4], joint.covariance[:, 4], rtol=1e-9, atol=1e-15)
    assert (family.position[1:] >= joint.position[1:] * (1 - 1e-9)).all()
    assert (family.position[1:] >= alone.position[1:] * (1 - 1e-9)).all()


def test_more_data_never_raise_the_bound() -> None:
    """Whatever the number of vehicles, and with odometry that tells nothing from one frame to the next."""
    made = record(load_scenario("lane:14", {"horizon": 1.0, "noise.velocity": 2.0}), 0)
    assert (cramer_rao(made).position <= cramer_rao_ancestors(made).position * (1 + 1e-9)).all()


def test_ancestors_bound_is_that_of_a_smaller_world() -> None:
    """Blind the others: the bound joint over all is then the one over the family."""
    made = small_record(3)
    for vehicle in range(5):
        others = [i for i in range(5) if i not in ancestors(made, vehicle)]
        visible = made.visible.copy()
        visible[:, others] = False
        expected = cramer_rao(replace(made, visible=visible)).covariance[:, vehicle]
        assert_allclose(cramer_rao_ancestors(made).covariance[:, vehicle], expected, rtol=1e-9, atol=1e-15)


def test_the_papers_noise_counts_with_its_covariance():
    """Uniform deviations on the image plane across z, drawn, against the information of a bearing."""
    rng = np.random.default_rng(0)
    scale = 0.005
    noise = SensorNoise(0.1, 0.01, 1 / 60, scale / np.sqrt(3), (0.0, 0.0, 1.0))
    u = np.array([0.8, -0.3, 0.4]) / np.linalg.norm([0.8, -0.3, 0.4])
    xy = u[:2] / u[2] + rng.uniform(-scale, scale, (400_000, 2))
    drawn = np.column_stack([xy, np.ones(len(xy))])
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    covariance = np.cov(drawn.T)
    information = noise.bearing_information(u[None])[0]
    across = np.eye(3) - np.outer(u, u)
    assert_allclose(information @ (covariance + MIN_BEARING_STD**2 * across), across, atol=0.01)
    on_axis = noise.bearing_information(np.array([[0.0, 0.0, 1.0]]))[0]
    assert_allclose(on_axis, np.diag([1.0, 1.0, 0.0]) / (noise.bearing**2 + 1e-8), rtol=1e-6)


def test_no_noise_no_bound():
    made = record(load_scenario("busy_intersection", {"horizon": 0.2, "noise.enabled": False}), 0)
    assert np.isnan(cramer_rao(made).position).all()


# Errors that last


STD = {"scale": 0.05, "bias": 0.03, "mounting": 0.02, "place": 0.04, "clock": 0.03}
SIZES = {"scale": 1, "bias": 3, "mounting": 3, "place": 3, "clock": 1}
KEYS = {
    "scale": ("odometry_scale", 0.05),
    "bias": ("gyro_bias", (0.03, 0.03, 0.03)),
    "mounting": ("camera_orientation", 0.02),
    "place": ("camera_position", 0.04),
    "clock": ("clock_offset", 0.03),
}
TICKS = 3


def with_declared_errors(made: Recording, *names: str) -> Recording:
    """Return a record of vehicles with declared errors."""
    noises = dict(KEYS[name] for name in names)
    setups = tuple(replace(setup, noise=replace(setup.noise, **noises)) for setup in made.setups)
    return replace(made, setups=setups)


def poses_and_residuals(made: Recording, x: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the last poses as (N, 6) offsets from the truth, and all bearings, for deviations of what is unknown."""
    truth, dt, L = made.truth, made.dt, made.landmarks.shape[1]
    R = [truth.rotation[0] @ Rotation.from_rotvec(x["start"][:, :3]).as_matrix()]
    p = [truth.position[0] + np.einsum("nij,nj->ni", truth.rotation[0], x["start"][:, 3:])]
    for k in range(1, made.ticks):
        back = truth.rotation[k - 1].swapaxes(-1, -2)
        turn = Rotation.from_matrix(back @ truth.rotation[k]).as_rotvec() - x["bias"] * dt - x["odometry"][k - 1, :, :3]
        way = np.einsum("nij,nj->ni", back, truth.position[k] - truth.position[k - 1])
        way = way / (1.0 + x["scale"]) - x["odometry"][k - 1, :, 3:]
        p.append(p[-1] + np.einsum("nij,nj->ni", R[-1], way))
        R.append(R[-1] @ Rotation.from_rotvec(turn).as_matrix())
    seen = []
    for k in range(1, made.ticks):
        for i, setup in enumerate(made.setups):
            for target in setup.targets[made.visible[k, i, setup.targets]]:
                j = int(target) - L
                if j < 0:
                    z = made.landmarks[k, target]
                else:
                    marker = made.setups[j].marker
                    here, before = (truth.position[n, j] + truth.rotation[n, j] @ marker for n in (k, k - 1))
                    late = x["clock"][j, 0] - x["clock"][i, 0]
                    z = p[k][j] + R[k][j] @ marker + (here - before) / dt * late
                line = R[k][i].T @ (z - p[k][i]) - setup.lever_arm - x["place"][i]
                line = Rotation.from_rotvec(-x["mounting"][i]).apply(line / np.linalg.norm(line))
                seen.append(line / setup.noise.bearing)
    turned = Rotation.from_matrix(truth.rotation[-1].swapaxes(-1, -2) @ R[-1]).as_rotvec()
    moved = np.einsum("nji,nj->ni", truth.rotation[-1], p[-1] - truth.position[-1])
    return np.concatenate([turned, moved], axis=1).ravel(), np.concatenate(seen)


def by_differences(made: Recording, names: tuple[str, ...]) -> np.ndarray:
    """Return (N, 6, 6) the covariance of the last poses' errors from that of everything unknown."""
    N, K = len(made.setups), made.ticks
    shapes = {"start": (N, 6), "odometry": (K - 1, N, 6), **{name: (N, size) for name, size in SIZES.items()}}
    steps = made.setups[0].noise.odometry(made.dt)
    weights = {
        "start": np.tile(1.0 / np.diag(made.start_covariance[0]), N),
        "odometry": np.tile(1.0 / steps, N * (K - 1)),
        **{name: np.full(N * SIZES[name], STD[name] ** -2) for name in names},
    }

    def outcome(name: str, n: int, h: float) -> tuple[np.ndarray, np.ndarray]:
        x = {key: np.zeros(shape) for key, shape in shapes.items()}
        x[name].flat[n] = h
        return poses_and_residuals(made, x)

    columns = []
    for name in weights:
        for n in range(len(weights[name])):
            (pose_up, up), (pose_down, down) = outcome(name, n, 1e-5), outcome(name, n, -1e-5)
            columns.append((np.concatenate([pose_up - pose_down, up - down])) / 2e-5)
    J = np.array(columns).T
    pose, seen = J[: 6 * N], J[6 * N :]
    covariance = pose @ np.linalg.inv(np.diag(np.concatenate(list(weights.values()))) + seen.T @ seen) @ pose.T
    return np.array([covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(N)])


@pytest.mark.parametrize(
    "names",
    [
        *(pytest.param(names, marks=pytest.mark.slow) for names in (("scale", "bias"), ("mounting", "place"))),
        ("clock",),
        tuple(SIZES),
    ],
)
def test_errors_that_last_count_as_unknown(names: tuple[str, ...]) -> None:
    made = with_declared_errors(small_record(TICKS), *names)
    assert_same_covariance(cramer_rao(made).covariance[-1], by_differences(made, names), atol=3e-3)


def test_without_declared_errors_the_bound_is_of_poses() -> None:
    made = small_record(TICKS)
    assert len(error_states(made)[0]) == 6
    plain, more = cramer_rao(made), cramer_rao(with_declared_errors(made, "scale", "bias", "mounting", "clock"))
    assert (more.position[1:] > plain.position[1:]).all()


def test_an_error_that_walks_grows() -> None:
    """Nothing seen: the variance along the way is that of the start, of white noise, and of a scale that walks."""
    made = small_record(30)
    noise = replace(made.setups[0].noise, odometry_scale_walk=0.5)
    blind = replace(
        made,
        visible=np.zeros_like(made.visible),
        setups=tuple(replace(setup, noise=noise) for setup in made.setups),
    )
    dt, K = made.dt, made.ticks - 1
    way = np.linalg.norm(np.diff(made.truth.position[:, 0], axis=0), axis=-1).mean()
    plain = replace(blind, setups=made.setups)
    more = cramer_rao(blind).covariance[-1, 0, 3:, 3:] - cramer_rao(plain).covariance[-1, 0, 3:, 3:]
    lasts = np.arange(K - 1, -1, -1.0)  # of the increments of the walk, each acts on so many later steps
    assert np.trace(more) == pytest.approx(0.25 * dt * way**2 * (lasts**2).sum(), rel=0.02)
