"""One camera tick of the paper's observer by splitting into exactly solvable parts, one vehicle at a time.

predict: over dt with v and omega held; exact, because V = diag(v1 I, v2 I) commutes with the rotation.
correct: over h with C frozen; exact for every gain k, by the eigenvectors of P^(1/2) C^T Q C P^(1/2).
Where the attitude would turn by more than `theta_max` in one go, h is cut and C evaluated anew.
A bearing is the unit vector from the camera to the target in the body frame; its sign does not matter here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .continuous import Result, Scenario, angle_between_deg, exponential, left_jacobian, skew

Array = NDArray[np.float64]

THETA_MAX = 0.05  # rad
MAX_SUBSTEPS = 200


@dataclass(frozen=True)
class Estimate:
    """An observer's state: attitude R (3, 3), body-frame position p (3,), P (6, 6) over (2 lambda, p)."""

    R: Array
    p: Array
    P: Array

    @property
    def position(self) -> Array:
        """Return the inertial position R p, which is what neighbours receive."""
        return self.R @ self.p


def initial_estimate(R: ArrayLike, position: ArrayLike, P: ArrayLike) -> Estimate:
    """Return the estimate with attitude R and inertial position."""
    R = np.asarray(R, float)
    return Estimate(R, R.T @ np.asarray(position, float), np.asarray(P, float))


def predict(x: Estimate, omega: ArrayLike, v: ArrayLike, V: ArrayLike, dt: float) -> Estimate:
    """Integrate odometry over dt; V (6, 6) must be diag(v1 I, v2 I)."""
    omega, v = np.asarray(omega, float), np.asarray(v, float)
    E = exponential(-omega * dt)
    F = np.zeros((6, 6))
    F[:3, :3] = F[3:, 3:] = E
    p = E @ x.p + left_jacobian(-omega * dt) @ v * dt
    return Estimate(x.R @ exponential(omega * dt), p, F @ x.P @ F.T + np.asarray(V, float) * dt)


def information(x: Estimate, bearings: Array, positions: Array, q: Array, lever_arm: Array) -> tuple[Array, Array]:
    """Return M = sum q C^T C (6, 6) and r = sum q C^T (y - C_2 p_hat) (6,) over the visible targets."""
    M, r = np.zeros((6, 6)), np.zeros(6)
    for b, z, weight in zip(bearings, positions, q, strict=True):
        Pi = np.eye(3) - np.outer(b, b)
        z_body = x.R.T @ z
        C = np.hstack([-Pi @ skew(z_body), Pi])
        M += weight * C.T @ C
        r += weight * C.T @ Pi @ (z_body - lever_arm - x.p)
    return M, r


@dataclass(frozen=True)
class Flow:
    """The correction with C frozen, diagonal in the basis T: P = T T^T and T^T M T = diag(m)."""

    T: Array
    m: Array
    s: Array  # T^T r
    k: float

    def dx(self, h: float) -> Array:
        """Return the state's change (6,) over h."""
        m = self.m
        tiny = m * h < 1e-12
        safe = np.where(tiny, 1.0, m)
        gain = np.where(tiny, self.k * h, -np.expm1(-self.k * np.log1p(safe * h)) / safe)
        return self.T @ (gain * self.s)

    def covariance(self, h: float) -> Array:
        """Return P after h."""
        return (self.T / (1.0 + self.m * h)) @ self.T.T


def frozen_flow(P: Array, M: Array, r: Array, k: float) -> Flow:
    """Diagonalise P and M together."""
    L = np.linalg.cholesky(P)
    m, U = np.linalg.eigh(L.T @ M @ L)
    T = L @ U
    return Flow(T, np.maximum(m, 0.0), T.T @ r, k)


def correct(
    x: Estimate,
    bearings: ArrayLike,
    positions: ArrayLike,
    q: ArrayLike,
    k: float,
    h: float,
    lever_arm: ArrayLike = (0.0, 0.0, 0.0),
    theta_max: float = THETA_MAX,
) -> Estimate:
    """Correct over h with bearings (m, 3) to targets at inertial `positions` (m, 3).

    The last allowed sub-step takes all that remains, however far it turns.
    """
    bearings, positions = np.reshape(bearings, (-1, 3)), np.reshape(positions, (-1, 3))
    weights = np.broadcast_to(np.asarray(q, float), (len(bearings),))
    if not len(bearings):
        return x
    lever = np.asarray(lever_arm, float)
    remaining, substeps = h, 0
    while remaining > 0.0:
        flow = frozen_flow(x.P, *information(x, bearings, positions, weights, lever), k)
        step, substeps = remaining, substeps + 1
        dx = flow.dx(step)
        if substeps < MAX_SUBSTEPS:
            while (turn := float(np.linalg.norm(dx[:3]))) > theta_max:
                step *= float(np.clip(0.9 * theta_max / turn, 0.1, 0.9))
                dx = flow.dx(step)
        x = Estimate(x.R @ exponential(dx[:3]), x.p + dx[3:], flow.covariance(step))
        remaining = 0.0 if step == remaining else remaining - step
    return x


def tick(
    x: Estimate,
    omega: ArrayLike,
    v: ArrayLike,
    bearings: ArrayLike,
    positions: ArrayLike,
    dt: float,
    k: float,
    q: ArrayLike,
    V: ArrayLike,
    lever_arm: ArrayLike,
) -> Estimate:
    """Predict over dt to the time of the camera frame, then correct with it for as long."""
    return correct(predict(x, omega, v, V, dt), bearings, positions, q, k, dt, lever_arm)


def run(scenario: Scenario, horizon: float, rate: float) -> Result:
    """Run the scenario at a camera rate, sampled at every tick (t = 0 included).

    A vehicle uses what its neighbours estimated in this very tick (lower numbers first).
    """
    n, dt = scenario.num_vehicles, 1.0 / rate
    steps = round(horizon * rate)
    x = [initial_estimate(scenario.R_hat[i], scenario.position_hat[i], scenario.P0) for i in range(n)]
    history: list[Sequence[Estimate]] = [tuple(x)]
    for s in range(1, steps + 1):
        landmarks = scenario.landmark_positions(s * dt)
        for i, neighbours in enumerate(scenario.neighbours):
            omega, v, lever_arm = scenario.angular_velocity[i], scenario.velocity[i], scenario.lever_arm[i]
            positions = [landmarks[j] if j < len(landmarks) else x[j - len(landmarks)].position for j in neighbours]
            gains = scenario.k, scenario.q, scenario.V
            x[i] = tick(x[i], omega, v, scenario.bearings(s * dt, i), positions, dt, *gains, lever_arm)
        history.append(tuple(x))
    return _result(scenario, np.arange(steps + 1, dtype=np.float64) * dt, history)


def _result(scenario: Scenario, t: Array, history: Sequence[Sequence[Estimate]]) -> Result:
    truth = [scenario.pose(float(s)) for s in t]
    R = np.array([r for r, _ in truth])
    R_hat = np.array([[e.R for e in row] for row in history])
    estimated = np.array([[e.position for e in row] for row in history])
    return Result(
        t=t,
        R_hat=R_hat,
        p_hat=np.array([[e.p for e in row] for row in history]),
        P=np.array([[e.P for e in row] for row in history]),
        position_error=np.array([p for _, p in truth]) - estimated,
        angle_error_deg=angle_between_deg(R_hat, R),
    )
