"""The observer with joint messages on the host."""

from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.planar.plugin import PlanarRobust
from coopenv.observers.robust.joint.kernels import ROBUST_JOINT


def robust_joint(setup: Setup) -> Observer:
    """The robust observer with larger, joint messages.

    Planar robots have one with small messages only.
    """
    return PlanarRobust(setup) if setup.planar else KernelObserver(ROBUST_JOINT, setup)
