"""Observers of one's own, the zoo that they are compared with, and the runner that judges them."""

from coopenv.estimation.coordinates import Coordinates
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
from coopenv.observers.registry import find, observer_names, register
from coopenv.observers.runner import Run, run

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
    "observer_names",
    "register",
    "run",
]
