"""The bound with errors that last, against the information of a whole record by finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.observers import Recording
from coopenv.observers.bound import cramer_rao, error_states
from tests.oracles.batch import assert_same_covariance, small_record

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


def told_of(made: Recording, *names: str) -> Recording:
    """Return a record whose vehicles have been told of errors."""
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


@pytest.mark.parametrize("names", [("scale", "bias"), ("mounting", "place"), ("clock",), tuple(SIZES)])
def test_errors_that_last_count_as_unknown(names: tuple[str, ...]) -> None:
    made = told_of(small_record(TICKS), *names)
    assert_same_covariance(cramer_rao(made).covariance[-1], by_differences(made, names), atol=3e-3)


def test_who_is_told_of_nothing_has_the_bound_of_poses() -> None:
    made = small_record(TICKS)
    assert len(error_states(made)[0]) == 6
    plain, more = cramer_rao(made), cramer_rao(told_of(made, "scale", "bias", "mounting", "clock"))
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
