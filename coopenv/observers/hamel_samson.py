"""The single-vehicle Riccati observer: bearings to known landmarks only.

Source: Hamel and Samson, Riccati observers for the nonstationary PnP problem, IEEE Transactions on Automatic Control
63(3), 2018; in the coordinates and with the gains of the cooperative observer that builds on it (see riccati/).
"""

from dataclasses import replace
from typing import Any

from coopenv.observers.contract import Message, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.riccati.kernels import RICCATI


class HamelSamson(KernelObserver):
    """The paper's observer with landmarks alone."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(RICCATI, replace(setup, targets=setup.targets[setup.targets < setup.landmarks]))

    def message(self) -> Message:
        """Return an empty message."""
        return Message()

    def __reduce__(self) -> Any:
        return HamelSamson, (self.setup,), super().__reduce__()[2]
