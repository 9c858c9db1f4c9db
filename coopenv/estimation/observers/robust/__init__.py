"""This project's own observer; see observer.py, and joint.py for the one with larger messages."""

from coopenv.estimation.observers.robust.joint import RobustJoint
from coopenv.estimation.observers.robust.observer import Robust

__all__ = ["Robust", "RobustJoint"]
