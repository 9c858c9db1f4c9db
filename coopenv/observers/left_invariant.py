"""Left-invariant extended Kalman filter on SE(3), with the neighbours' covariance as measurement noise.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE Transactions on Automatic
Control 62(4), 2017. Errors: T = That Exp(xi). Odometry T <- T U is group affine, so that xi <- Ad(U^-1) xi is exact for
errors of any size. H is that of mekf.py: the errors agree to first order, and the filters differ by the retraction.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import adjoint, exp_se3, skew
from coopenv.observers.mekf import LeftError, Mekf

IDENTITY_6 = np.eye(6)


@dataclass(frozen=True)
class InvariantError(LeftError):
    """A pose with a covariance over xi, which is also that over the left error to first order."""

    @staticmethod
    def transition(rotation: Array, translation: Array) -> Array:
        """Return F (6, 6) of the error over an odometry increment (dR, dp)."""
        return adjoint(rotation.T, -rotation.T.dot(translation))

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx = xi."""
        turn, shift = exp_se3(np.asarray(dx))
        return type(self)(self.R.dot(turn), self.p + self.R.dot(shift), P)

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return the right Jacobian of SE(3) at dx, up to the fourth order."""
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = skew(dx[:3])
        A[3:, :3] = skew(dx[3:])
        G = IDENTITY_6 - A / 5.0
        for n in (4.0, 3.0, 2.0):
            G = IDENTITY_6 - A.dot(G) / n
        return G


class LeftInvariant(Mekf):
    """Invariant filter, left error; sends covariances."""

    belief: ClassVar[type[LeftError]] = InvariantError
    sends_covariance = True
