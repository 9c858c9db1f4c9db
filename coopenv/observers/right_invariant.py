"""Right-invariant extended Kalman filter, with the neighbours' covariance as measurement noise.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE Transactions on Automatic
Control 62(4), 2017. Errors: R = Exp(theta) Rhat, p = Exp(theta) phat + rho. F = I;
G = [Rhat, 0; S(phat) Rhat, Rhat];  H = B Rhat^T [S(z), -I] / |d|, which depends on the map's origin through z.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import IDENTITY, exp_so3, orthonormalise, right_jacobian, skew
from coopenv.observers.contract import Estimate, Tick
from coopenv.observers.mekf import LeftError, Mekf


def from_left(R: Array, p: Array) -> Array:
    """Return G, which turns left errors (theta, rho) at a pose into right ones."""
    G = np.zeros((6, 6))
    G[:3, :3] = G[3:, 3:] = R
    G[3:, :3] = skew(p).dot(R)
    return G


@dataclass(frozen=True)
class RightError(LeftError):
    """A pose with a covariance over its right error."""

    right: ClassVar[bool] = True

    @classmethod
    def start(cls, R: Array, p: Array, P: Array) -> Self:
        """Return the state of a pose with a covariance in LEFT coordinates."""
        G = from_left(R, p)
        return super().start(R, p, G.dot(P).dot(G.T))

    def predicted(self, tick: Tick) -> Self:
        """Return the state after the tick's odometry."""
        R, p = orthonormalise(self.R.dot(tick.rotation)), self.p + self.R.dot(tick.translation)
        G = from_left(R, p)
        return type(self)(R, p, self.P + (G * tick.noise.odometry(tick.dt)).dot(G.T))

    def jacobian(self, positions: Array) -> Array:
        """Return (m, 3, 6) the derivative of the lines to map positions (m, 3)."""
        J = np.empty((len(positions), 3, 6))
        J[:, :, :3] = self.R.T @ skew(positions)
        J[:, :, 3:] = -self.R.T
        return J

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx."""
        turn = exp_so3(dx[:3])
        return type(self)(turn.dot(self.R), turn.dot(self.p) + dx[3:], P)

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return G (6, 6): about the state moved by dx, an error of dx + d about this one is G d to first order."""
        G = np.eye(6)
        G[:3, :3] = right_jacobian(-dx[:3])
        G[3:, :3] = skew(dx[3:]).dot(G[:3, :3])
        return G

    def point_covariance(self, marker: Array) -> Array:
        """Return the covariance (3, 3) in map axes of a point of the body."""
        J = np.concatenate([skew(-self.p - self.R.dot(marker)), IDENTITY], axis=1)
        return np.asarray(J.dot(self.P).dot(J.T))

    def estimate(self, nis: float | None = None, nis_dof: int = 0) -> Estimate:
        """Return the pose with its covariance, and the normalised innovation squared of its correction."""
        return Estimate(self.R, self.p, self.P, Coordinates.RIGHT, nis, nis_dof)


class RightInvariant(Mekf):
    """Invariant filter, right error; sends covariances."""

    belief: ClassVar[type[LeftError]] = RightError
    sends_covariance = True
