"""The error-state filter with the neighbours' covariance as measurement noise.

Source: N + H_j P_j H_j^T, as if neighbours' errors were independent of one's own (Roumeliotis and Bekey, Distributed
multirobot localization, 2002, keep the cross-correlation that this leaves out). Overconfident down the chain.
"""

from coopenv.observers.contract import Setup
from coopenv.observers.mekf import Mekf


class MekfCovariance(Mekf):
    """Error-state filter; weighs what it hears by covariance.

    It sends position and covariance, and adds a sender's covariance to the bearing's noise.
    """

    sends_covariance = True


class MekfCovarianceUngated(MekfCovariance):
    """Error-state filter that believes every bearing.

    It is `mekf_covariance` without a gate and without cheirality.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, gated=False)
