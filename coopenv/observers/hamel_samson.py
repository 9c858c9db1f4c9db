"""The single-vehicle Riccati observer: bearings to known landmarks only.

Source: Hamel and Samson, Riccati observers for the nonstationary PnP problem, IEEE Transactions on Automatic Control
63(3), 2018; in the coordinates and with the gains of the cooperative observer that builds on it (see riccati.py).
"""

from __future__ import annotations

from coopenv.observers.contract import Message
from coopenv.observers.riccati.plugin import Riccati


class HamelSamson(Riccati):
    """The paper's observer with landmarks alone."""

    landmarks_only = True

    def message(self) -> Message:
        """Return an empty message."""
        return Message()
