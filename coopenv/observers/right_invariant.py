"""Right-invariant extended Kalman filter, with the neighbours' covariance as measurement noise.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE Transactions on Automatic
Control 62(4), 2017. Errors: R = Exp(theta) Rhat, p = Exp(theta) phat + rho. F = I;
G = [Rhat, 0; S(phat) Rhat, Rhat];  H = B Rhat^T [S(z), -I] / |d|, which depends on the map's origin through z.
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.compiled_matrices import congruent
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import IDENTITY, skew
from coopenv.observers.contract import Estimate
from coopenv.observers.mekf import LeftError, Mekf
from coopenv.observers.pose_errors import RIGHT, from_left


@dataclass(frozen=True)
class RightError(LeftError):
    """A pose with a covariance over its right error."""

    kind: ClassVar[int] = RIGHT

    @classmethod
    def start(cls, R: Array, p: Array, P: Array) -> Self:
        """Return the state of a pose with a covariance in LEFT coordinates."""
        left = LeftError.start(R, p, P)
        return cls(left.R, left.p, congruent(from_left(left.R, left.p), left.P))

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
