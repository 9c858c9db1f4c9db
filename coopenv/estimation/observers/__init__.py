"""Observers of one's own, the zoo that they are compared with, and the runner that judges them."""

from coopenv.estimation.observers.base import (
    Coordinates,
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
from coopenv.estimation.observers.registry import find, observer_names, register
from coopenv.estimation.observers.runner import Recording, Run, record, run

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
    "record",
    "register",
    "run",
]
