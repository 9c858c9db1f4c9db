"""Error-state (multiplicative) Kalman filter with body-frame errors; neighbours are taken as exact.

Source: Lefferts, Markley and Shuster, Kalman filtering for spacecraft attitude estimation, 1982 (multiplicative
error); the bearing as a residual in its tangent plane. Errors: R = Rhat Exp(theta), p = phat + Rhat rho.

Over a tick of odometry (dR, dp), with E = dR^T:  F = [E, 0; -E S(dp), E].
With a = Rhat^T (z - phat), d = a - c the line from the camera c, and B a tangent basis at d / |d|:
H = B [S(a), -I] / |d|,  residual B b.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array, solve
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import IDENTITY, exp_so3, lengths, orthonormalise, skew, tangent_basis
from coopenv.observers.contract import Estimate, Message, Setup, Tick


def innovation(R: Array, p: Array, lever_arm: Array, bearings: Array, positions: Array) -> tuple[Array, Array]:
    """Return (residual (m, 2), J (m, 2, 3)): tangent residuals and their derivative by the line d in the body frame."""
    d = (positions - p).dot(R) - lever_arm
    distance = np.maximum(lengths(d), 1e-9)[:, None]
    B = tangent_basis(d / distance)
    return (B @ bearings[..., None])[..., 0], B / distance[..., None]


@dataclass(frozen=True)
class LeftError:
    """A pose with a covariance over its left error."""

    R: Array
    p: Array  # map frame
    P: Array

    @classmethod
    def start(cls, R: Array, p: Array, P: Array) -> Self:
        """Return the state of a pose with a covariance in LEFT coordinates."""
        return cls(np.array(R, float), np.array(p, float), np.array(P, float))

    @staticmethod
    def transition(rotation: Array, translation: Array) -> Array:
        """Return F (6, 6) of the error over an odometry increment (dR, dp)."""
        F = np.zeros((6, 6))
        E = rotation.T
        F[:3, :3] = F[3:, 3:] = E
        F[3:, :3] = E.dot(skew(-translation))
        return F

    def predicted(self, tick: Tick) -> Self:
        """Return the state after the tick's odometry."""
        F = self.transition(tick.rotation, tick.translation)
        P = F.dot(self.P).dot(F.T)
        P.flat[::7] += tick.noise.odometry(tick.dt)
        return type(self)(orthonormalise(self.R.dot(tick.rotation)), self.p + self.R.dot(tick.translation), P)

    def jacobian(self, positions: Array) -> Array:
        """Return (m, 3, 6) the derivative of the lines to map positions (m, 3)."""
        J = np.empty((len(positions), 3, 6))
        J[:, :, :3] = skew((positions - self.p).dot(self.R))
        J[:, :, 3:] = -IDENTITY
        return J

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx."""
        return type(self)(self.R.dot(exp_so3(dx[:3])), self.p + self.R.dot(dx[3:]), P)

    def point_covariance(self, marker: Array) -> Array:
        """Return the covariance (3, 3) in map axes of a point of the body."""
        J = np.empty((3, 6))
        J[:, :3] = self.R.dot(skew(-marker))
        J[:, 3:] = self.R
        return np.asarray(J.dot(self.P).dot(J.T))

    def estimate(self, nis: float | None = None, nis_dof: int = 0) -> Estimate:
        """Return the pose with its covariance, and the normalised innovation squared of its correction."""
        return Estimate(self.R, self.p, self.P, Coordinates.LEFT, nis, nis_dof)


def kalman(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return (dx, P+, r^T S^-1 r) of a Kalman update with measurement covariance N, in Joseph's form."""
    PHt = P.dot(H.T)
    solved = solve(H.dot(PHt) + N, np.concatenate([PHt.T, residual[:, None]], axis=1))
    K = solved[:, :-1].T
    A = -K.dot(H)
    A.flat[:: len(P) + 1] += 1.0
    P = A.dot(P).dot(A.T) + K.dot(N).dot(K.T)
    return K.dot(residual), (P + P.T) / 2, float(residual.dot(solved[:, -1]))


class PoseObserver:
    """What observers share that believe in one pose and a covariance, and tell where their marker is."""

    belief: ClassVar[type[LeftError]] = LeftError
    sends_covariance = True

    def __init__(self, setup: Setup) -> None:
        self.marker = setup.marker  # what others measure

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        self.state = self.belief.start(*initial_pose, initial_covariance)

    def message(self) -> Message:
        """Return the marker's position, and its covariance if this observer sends it."""
        covariance = self.state.point_covariance(self.marker) if self.sends_covariance else None
        return Message(position=self.state.p + self.state.R.dot(self.marker), covariance=covariance)


class Mekf(PoseObserver):
    """Error-state filter; trusts the positions that it hears.

    It sends its position alone.
    """

    sends_covariance = False

    def update(self, tick: Tick) -> Estimate:
        """Predict, then correct by every usable bearing."""
        self.state = self.state.predicted(tick)
        self.nis: float | None = None
        self.nis_dof = 0
        seen = tick.usable() if tick.due else []
        if seen:
            b, z = np.array([s[1] for s in seen]), np.array([s[2] for s in seen])
            self.correct(tick, b, z, [s[3] for s in seen])
        return self.state.estimate(self.nis, self.nis_dof)

    def correct(self, tick: Tick, b: Array, z: Array, messages: list[Message | None]) -> None:
        """Correct by bearings b (m, 3) to positions z (m, 3)."""
        residual, J = innovation(self.state.R, self.state.p, tick.lever_arm, b, z)
        H = (J @ self.state.jacobian(z)).reshape(-1, 6)
        dx, P, self.nis = kalman(self.state.P, H, self.noise(tick, J, messages), residual.ravel())
        self.state, self.nis_dof = self.state.moved(dx, P), len(H)

    def noise(self, tick: Tick, J: Array, messages: list[Message | None]) -> Array:
        """Return (2m, 2m) the covariance of the residuals given one's own pose; J as from `innovation`."""
        size = 2 * len(messages)
        N = np.zeros((size, size))
        N.flat[:: size + 1] = tick.noise.bearing_std**2
        for n, message in enumerate(messages):
            if self.sends_covariance and message is not None and message.covariance is not None:
                G = J[n].dot(self.state.R.T)
                N[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] += G.dot(message.covariance).dot(G.T)
        return N
