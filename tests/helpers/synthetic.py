"""A made-up run with the paper's five vehicles, whose errors are known in closed form.

Nothing here calls the code under test: rotations are SciPy's, errors are exp(-rate t) by construction.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.estimation import Sight
from coopenv.estimation.trajectory import Trajectory

LANDMARKS = np.array([(-4.0, 5.0, 3.0), (4.0, 4.0, 5.0), (4.0, -3.0, 4.0)])
START = np.array([(-2, -16, 2.5), (-2, -19, 2), (-17, 2, 3), (-19, 2, 3.5), (-30, 2, 3)], float)
VELOCITY = np.array([(0, 0.6, 0), (0, 0.5, 0), (0.6, 0, 0), (0.45, 0, 0), (0.6, 0, 0)])
INITIAL_ERROR = np.array([(-2, -11, -2.5), (-7, -5, -4), (-9, -1, -2), (-5, -4, -2.5), (-6, -5, -3)], float)
INITIAL_ANGLE_DEG = 90.0
RATE = np.array([1.2, 0.7, 0.5, 0.4, 0.2])  # 1/s
NEIGHBOURS = ((0, 1, 2), (1, 2, 3), (1, 2, 4), (2, 4, 5), (3, 4, 6))


def make_trajectory(ticks: int = 3001, dt: float = 1 / 60, noise: float = 0.0, yaw_rate: float = 0.0) -> Trajectory:
    """Return five vehicles at constant velocity that estimate their poses ever better.

    Args:
        ticks: K, t = 0 included.
        dt: s between ticks.
        noise: m and deg of white estimation error added to the exponential (fixed seed).
        yaw_rate: rad/s at which every body turns while its path stays straight.
    """
    rng = np.random.default_rng(7)
    t = np.arange(ticks) * dt
    position = START + VELOCITY * t[:, None, None]
    shape = position.shape[:2]
    rotation = np.broadcast_to(_about_z(yaw_rate * t)[:, None], (*shape, 3, 3)).copy()

    decay = np.exp(-RATE * t[:, None])
    error = INITIAL_ERROR * decay[..., None] + noise * rng.standard_normal((*shape, 3))
    axis_angle = np.zeros((*shape, 3))
    axis_angle[..., 2] = np.radians(INITIAL_ANGLE_DEG * decay)
    axis_angle += np.radians(noise * rng.standard_normal((*shape, 3)))
    tilde = Rotation.from_rotvec(axis_angle.reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3)
    rotation_estimate = rotation @ np.swapaxes(tilde, -1, -2)  # Rtilde = Rhat^T R

    covariance = np.zeros((*shape, 6, 6))
    decaying = decay[..., None]
    sigma = np.concatenate([decaying + np.radians(noise) + 1e-4, 6 * decaying + noise + 1e-3], axis=-1)
    covariance[..., range(6), range(6)] = np.repeat(sigma**2, 3, axis=-1)
    estimate = position - error
    coordinates = np.concatenate([2 * _vector_part(axis_angle), _body(rotation, position)], axis=-1)
    coordinates[..., 3:] -= _body(rotation_estimate, estimate)

    target_position = np.concatenate([np.broadcast_to(LANDMARKS, (ticks, 3, 3)), position], axis=1)
    sight = _sight(t)
    return Trajectory(
        t=t,
        position=position,
        rotation=rotation,
        position_estimate=estimate,
        rotation_estimate=rotation_estimate,
        position_error=np.sqrt((error**2).sum(-1)),
        orientation_error=np.degrees(np.sqrt((axis_angle**2).sum(-1))),
        covariance=covariance,
        nees=(coordinates**2 / np.repeat(sigma**2, 3, axis=-1)).sum(-1),
        protection_level=np.full((*shape, 2), np.inf),
        velocity=_body(rotation, np.broadcast_to(VELOCITY, position.shape)),
        angular_velocity=np.broadcast_to([0.0, 0.0, yaw_rate], position.shape).copy(),
        target_position=target_position,
        visible=sight == Sight.VISIBLE,
        sight=sight,
        reward_terms=np.zeros((*shape, 2)),
        terms=np.array(["control", "time"]),
        vehicles=np.array([f"vehicle_{i}" for i in range(1, 6)]),
        targets=np.array([f"landmark_{i}" for i in range(1, 4)] + [f"vehicle_{i}" for i in range(1, 6)]),
        target_moving=np.array([False] * 3 + [True] * 5),
    )


def _sight(t: np.ndarray) -> np.ndarray:
    """Return (K, 5, 8) of why each target is seen or not: the paper's neighbours, switching."""
    sight = np.full((len(t), 5, 8), Sight.NOT_A_NEIGHBOUR, dtype=np.uint8)
    for vehicle, neighbours in enumerate(NEIGHBOURS):
        sight[:, vehicle, neighbours] = Sight.VISIBLE
    sight[(t > 21) & (t < 25) & (np.sin(9 * t) > -0.5), 0, 1] = Sight.OCCLUDED_BY_BODY
    sight[(t > 21) & (t < 25), 0, 4] = Sight.VISIBLE
    sight[(t > 38), 0, 2] = Sight.OUT_OF_VIEW
    sight[(t > 12) & (t < 18), 1, 3] = Sight.OUT_OF_VIEW
    sight[(t > 29) & (t < 34), 2, 2] = Sight.OCCLUDED_BY_BUILDING
    sight[(t > 31) & (t < 34), 2, 4] = Sight.OCCLUDED_BY_BODY
    sight[np.sin(3 * t) > 0.97, 3, 5] = Sight.MISSED
    sight[t < 6, 4, 6] = Sight.OCCLUDED_BY_BUILDING
    return sight


def _about_z(angle: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()


def _body(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.einsum("knji,knj->kni", rotation, vector)


def _vector_part(axis_angle: np.ndarray) -> np.ndarray:
    q = Rotation.from_rotvec(axis_angle.reshape(-1, 3)).as_quat(canonical=True)
    return q[:, :3].reshape(axis_angle.shape)
