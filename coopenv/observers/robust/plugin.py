"""This project's own observer; see reference/observer.py, and reference/joint.py for the one with larger messages."""

from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.planar.plugin import PlanarRobust
from coopenv.observers.robust.kernels import ROBUST
from coopenv.observers.robust.reference.joint import RobustJoint


def robust(setup: Setup) -> Observer:
    """This project's observer: several hypotheses, gates.

    Where a vehicle moves on a plane and its odometry is its commands, it is a planar one.
    """
    return PlanarRobust(setup) if setup.planar else KernelObserver(ROBUST, setup)


def robust_joint(setup: Setup) -> Observer:
    """The robust observer with larger, joint messages.

    Planar robots have one with small messages only.
    """
    return PlanarRobust(setup) if setup.planar else RobustJoint(setup)
