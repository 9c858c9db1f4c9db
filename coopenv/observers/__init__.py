"""Observers of one's own, the zoo that they are compared with, and the runner that judges them."""

from typing import TYPE_CHECKING

from coopenv.base import lazy_names
from coopenv.observers.registry import find, list_observers, register

if TYPE_CHECKING:
    from coopenv.estimation.poses import Coordinates
    from coopenv.observers.contract import (
        Estimate,
        Gains,
        JointObserver,
        Message,
        Observer,
        Received,
        SensorNoise,
        Setup,
        Tick,
    )
    from coopenv.observers.recording import Recording
    from coopenv.observers.runner import Run, run
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = [
    "Coordinates",
    "Estimate",
    "Gains",
    "JointObserver",
    "Message",
    "Observer",
    "Received",
    "Recording",
    "Run",
    "SensorNoise",
    "Setup",
    "Tick",
    "find",
    "list_observers",
    "register",
    "run",
]
