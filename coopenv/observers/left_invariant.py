"""Left-invariant extended Kalman filter on SE(3), with the neighbours' covariance as measurement noise.

Source: Barrau and Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE Transactions on Automatic
Control 62(4), 2017. Errors: T = That Exp(xi). Odometry T <- T U is group affine, so that xi <- Ad(U^-1) xi is exact for
errors of any size. H is that of mekf.py: the errors agree to first order, and the filters differ by the retraction.
"""

from dataclasses import dataclass
from typing import ClassVar

from coopenv.observers.mekf import LeftError, Mekf
from coopenv.observers.pose_errors import INVARIANT


@dataclass(frozen=True)
class InvariantError(LeftError):
    """A pose with a covariance over xi, which is also that over the left error to first order."""

    kind: ClassVar[int] = INVARIANT


class LeftInvariant(Mekf):
    """Invariant filter, left error; sends covariances."""

    belief: ClassVar[type[LeftError]] = InvariantError
    sends_covariance = True
