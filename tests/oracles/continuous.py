"""The paper's decentralised observer in continuous time, noise free, by a general-purpose ODE solver.

Every symbol is the paper's: R_hat and p_hat obey eq. dot_estmate with the innovation terms of
eq. observer_body, P the continuous Riccati equation. A vehicle's neighbours are numbered landmarks first
(0 .. L-1), then vehicles (L .. L+N-1). With a camera at body point c the output is
y_ij = Pi_g (R_hat_i^T zhat_j - c); C_i keeps its form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def skew(x: ArrayLike) -> Array:
    """Return S(x) of vectors (..., 3), with S(x) y = x cross y."""
    return np.cross(np.eye(3), np.asarray(x, float)[..., None, :])


def exponential(theta: ArrayLike) -> Array:
    """Return the rotation matrices of rotation vectors (..., 3)."""
    theta = np.asarray(theta, float)
    return Rotation.from_rotvec(theta.reshape(-1, 3)).as_matrix().reshape(*theta.shape, 3)


def left_jacobian(theta: ArrayLike) -> Array:
    """Return int_0^1 Exp(s theta) ds for rotation vectors (..., 3)."""
    theta = np.asarray(theta, float)
    angle = np.linalg.norm(theta, axis=-1)[..., None, None]
    S = skew(theta)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 6.0 - angle**2 / 120.0 + angle**4 / 5040.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + second * S + third * (S @ S)


def angle_between_deg(R_hat: ArrayLike, R: ArrayLike) -> Array:
    """Return the geodesic angle between rotations (..., 3, 3) in degrees, accurate near 0 and near 180."""
    relative = np.swapaxes(np.asarray(R_hat, float), -1, -2) @ np.asarray(R, float)
    angles = Rotation.from_matrix(relative.reshape(-1, 3, 3)).magnitude()
    return np.degrees(angles).reshape(relative.shape[:-2])


@dataclass(frozen=True)
class Scenario:
    """A noise-free world: L landmarks, N vehicles of constant body twist, the observers' starts and gains."""

    landmarks: Array  # (L, 3) m, inertial, at t = 0
    neighbours: tuple[tuple[int, ...], ...]  # per vehicle; landmarks first, then vehicles
    position: Array  # (N, 3) m, inertial, at t = 0
    velocity: Array  # (N, 3) m/s, body frame, constant
    position_hat: Array  # (N, 3) m, inertial estimate at t = 0
    R_hat: Array  # (N, 3, 3) estimate at t = 0
    R: Array = field(default_factory=lambda: np.eye(3))  # (N, 3, 3) or (3, 3) at t = 0
    angular_velocity: Array = field(default_factory=lambda: np.zeros(3))  # (N, 3) or (3,) rad/s, body frame
    landmark_velocity: Array = field(default_factory=lambda: np.zeros(3))  # (L, 3) or (3,) m/s, inertial
    lever_arm: Array = field(default_factory=lambda: np.zeros(3))  # (N, 3) or (3,) m, camera in body
    k: float = 1.0
    q: float = 10.0
    V: Array = field(default_factory=lambda: np.diag([0.1] * 3 + [1.0] * 3))  # (6, 6)
    P0: Array = field(default_factory=lambda: np.diag([1.0] * 3 + [100.0] * 3))  # (6, 6)

    def __post_init__(self) -> None:
        """Give every per-vehicle field its leading axis."""
        n, m = len(self.position), len(self.landmarks)
        for name, shape in (
            ("landmarks", (m, 3)),
            ("landmark_velocity", (m, 3)),
            ("position", (n, 3)),
            ("velocity", (n, 3)),
            ("angular_velocity", (n, 3)),
            ("lever_arm", (n, 3)),
            ("position_hat", (n, 3)),
            ("R", (n, 3, 3)),
            ("R_hat", (n, 3, 3)),
        ):
            value = np.asarray(getattr(self, name), float)
            object.__setattr__(self, name, np.broadcast_to(value, shape).copy())

    @property
    def num_vehicles(self) -> int:
        """Return N."""
        return len(self.position)

    def pose(self, t: float) -> tuple[Array, Array]:
        """Return the true rotations (N, 3, 3) and inertial positions (N, 3) at time t."""
        theta = self.angular_velocity * t
        travelled = np.einsum("nij,njk,nk->ni", self.R, left_jacobian(theta), self.velocity * t)
        return self.R @ exponential(theta), self.position + travelled

    def landmark_positions(self, t: float) -> Array:
        """Return the landmarks' positions (L, 3) at time t."""
        return self.landmarks + self.landmark_velocity * t


def busy_intersection(mirror: bool = False) -> Scenario:
    """Return the paper's five-vehicle simulation; `mirror` takes the initial rotation the other way round."""
    turn = exponential([0.0, 0.0, np.pi / 2])
    return Scenario(
        landmarks=np.array([[-4.0, 5.0, 3.0], [4.0, 4.0, 5.0], [4.0, -3.0, 4.0]]),
        neighbours=((0, 1, 2), (1, 2, 3), (1, 2, 4), (2, 4, 5), (3, 4, 6)),
        position=np.array([[-2, -16, 2.5], [-2, -19, 2], [-17, 2, 3], [-19, 2, 3.5], [-30, 2, 3]], float),
        velocity=np.array([[0, 0.6, 0], [0, 0.5, 0], [0.6, 0, 0], [0.45, 0, 0], [0.6, 0, 0]]),
        position_hat=np.array([[0, -5, 5], [5, -14, 6], [-8, 3, 5], [-14, 6, 6], [-24, 7, 6]], float),
        R_hat=turn.T if mirror else turn,
    )


@dataclass(frozen=True)
class Result:
    """Sampled solution; T samples, N vehicles."""

    t: Array  # (T,) s
    R_hat: Array  # (T, N, 3, 3)
    p_hat: Array  # (T, N, 3) body frame
    P: Array  # (T, N, 6, 6)
    position_error: Array  # (T, N, 3) m, inertial: true position - R_hat p_hat
    angle_error_deg: Array  # (T, N)


def settle_times(
    t: Array, position_error: Array, angle_error_deg: Array, position: float = 0.1, angle_deg: float = 1.0
) -> Array:
    """Return per vehicle the first time from which both errors stay below the bounds; NaN if none."""
    inside = (np.linalg.norm(position_error, axis=-1) < position) & (angle_error_deg < angle_deg)
    times = np.full(inside.shape[1], np.nan)
    for i in range(inside.shape[1]):
        outside = np.flatnonzero(~inside[:, i])
        first = outside[-1] + 1 if outside.size else 0
        if first < len(t):
            times[i] = t[first]
    return times


def right_hand_side(scenario: Scenario) -> Callable[[float, Array], Array]:
    """Return f(t, y) of the coupled observers; y holds per vehicle R_hat (9), p_hat (3) and P (36)."""
    n = scenario.num_vehicles
    most = max(len(s) for s in scenario.neighbours)
    index = np.zeros((n, most), dtype=np.intp)
    weight = np.zeros((n, most))
    for i, neighbours in enumerate(scenario.neighbours):
        index[i, : len(neighbours)] = neighbours
        weight[i, : len(neighbours)] = scenario.q
    omega, v, lever = scenario.angular_velocity, scenario.velocity, scenario.lever_arm
    S_omega = skew(omega)
    A = np.zeros((n, 6, 6))
    A[:, :3, :3] = A[:, 3:, 3:] = -S_omega
    C = np.zeros((n, most, 3, 6))
    k, V, identity = scenario.k, scenario.V, np.eye(3)

    def f(t: float, y: Array) -> Array:
        state = y.reshape(n, 48)
        R_hat, p_hat = state[:, :9].reshape(n, 3, 3), state[:, 9:12]
        P = state[:, 12:].reshape(n, 6, 6)
        R, position = scenario.pose(t)
        landmarks = scenario.landmark_positions(t)
        true = np.concatenate([landmarks, position])[index]
        communicated = np.concatenate([landmarks, (R_hat @ p_hat[..., None])[..., 0]])[index]
        d = (true - position[:, None]) @ R - lever[:, None]
        g = -d / np.sqrt((d * d).sum(axis=-1, keepdims=True))
        Pi = identity - g[..., :, None] * g[..., None, :]
        z = communicated @ R_hat  # rows R_hat_i^T zhat_j
        C[..., :3] = -Pi @ skew(z)
        C[..., 3:] = Pi
        innovation = (Pi @ (z - lever[:, None] - p_hat[:, None])[..., None])[..., 0]
        CtQ = (C * weight[..., None, None]).reshape(n, -1, 6).transpose(0, 2, 1)
        M = CtQ @ C.reshape(n, -1, 6)
        gain = k * (P @ (CtQ @ innovation.reshape(n, -1, 1)))[..., 0]
        out = np.empty((n, 48))
        out[:, :9] = (R_hat @ skew(omega + gain[:, :3])).reshape(n, 9)
        out[:, 9:12] = -(S_omega @ p_hat[..., None])[..., 0] + v + gain[:, 3:]
        AP = A @ P
        out[:, 12:] = (AP + AP.transpose(0, 2, 1) - P @ M @ P + V).reshape(n, 36)
        return out.ravel()

    return f


def solve(
    scenario: Scenario,
    horizon: float,
    sample: float = 0.05,
    method: str = "DOP853",
    rtol: float = 1e-8,
    atol: float = 1e-10,
) -> Result:
    """Integrate over [0, horizon] and sample; take method "LSODA" where k q P is stiff (k = 80)."""
    n = scenario.num_vehicles
    initial = np.empty((n, 48))
    initial[:, :9] = scenario.R_hat.reshape(n, 9)
    initial[:, 9:12] = np.einsum("nji,nj->ni", scenario.R_hat, scenario.position_hat)
    initial[:, 12:] = np.asarray(scenario.P0, float).ravel()
    t = np.linspace(0.0, horizon, round(horizon / sample) + 1)
    solution = solve_ivp(
        right_hand_side(scenario), (0.0, horizon), initial.ravel(), method, t_eval=t, rtol=rtol, atol=atol
    )
    if not solution.success:
        raise RuntimeError(solution.message)
    state = solution.y.T.reshape(len(t), n, 48)
    R_hat, p_hat = state[..., :9].reshape(-1, n, 3, 3), state[..., 9:12]
    truth = [scenario.pose(s) for s in t]
    R, position = np.array([r for r, _ in truth]), np.array([p for _, p in truth])
    return Result(
        t=t,
        R_hat=R_hat,
        p_hat=p_hat,
        P=state[..., 12:].reshape(-1, n, 6, 6),
        position_error=position - np.einsum("tnij,tnj->tni", R_hat, p_hat),
        angle_error_deg=angle_between_deg(R_hat, R),
    )


def small_error_case(
    k: float = 1.0,
    q: float = 10.0,
    lever_arm: ArrayLike = (0.0, 0.0, 0.0),
    angle: float = 0.1,
    offset: float = 0.3,
    seed: int = 0,
) -> Scenario:
    """Return three turning vehicles among four landmarks, in a cascade, with a start close to the truth."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(3, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    shift = rng.normal(size=(3, 3))
    shift *= offset / np.linalg.norm(shift, axis=-1, keepdims=True)
    R = exponential(np.array([[0.0, 0.0, 0.3], [0.1, 0.0, 2.0], [0.0, -0.1, -1.0]]))
    position = np.array([[0.0, 0.0, 0.5], [2.0, -1.0, 0.3], [-2.0, -1.5, 0.8]])
    case = Scenario(
        landmarks=np.array([[3.0, 3.0, 2.0], [-3.0, 2.5, 1.0], [0.5, 4.0, 3.0], [4.0, -2.0, 1.5]]),
        neighbours=((0, 1, 2), (0, 1, 3, 4), (2, 4, 5)),
        position=position,
        velocity=np.array([[0.4, 0.0, 0.0], [0.3, 0.05, 0.0], [0.5, 0.0, 0.02]]),
        angular_velocity=np.array([[0.0, 0.0, 0.3], [0.02, 0.0, -0.2], [0.0, 0.05, 0.4]]),
        R=R,
        position_hat=position + shift,
        R_hat=R @ exponential(angle * axis),
        lever_arm=np.asarray(lever_arm, float),
        P0=np.diag([1.0] * 3 + [10.0] * 3),
    )
    return replace(case, k=k, q=q)
