"""Odometry alone: the lower reference.

Source: composition of the increments; covariance as in the prediction of the left-error filter (see mekf.py).
"""

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.mekf import LeftError


class DeadReckoning:
    """Adds up odometry and sends nothing."""

    def __init__(self, setup: Setup) -> None:
        """Nothing to set up."""

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        self.state = LeftError.start(*initial_pose, initial_covariance)

    def update(self, tick: Tick) -> Estimate:
        """Append the increment."""
        self.state = self.state.predicted(tick)
        return self.state.estimate()

    def message(self) -> Message:
        """Return an empty message."""
        return Message()
