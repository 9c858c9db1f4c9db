"""This project's own observer on the host."""

from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.planar.plugin import PlanarRobust
from coopenv.observers.robust.kernels import ROBUST


def robust(setup: Setup) -> Observer:
    """This project's observer: several hypotheses, gates.

    Where a vehicle moves on a plane and its odometry is its commands, it is a planar one.
    """
    return PlanarRobust(setup) if setup.planar else KernelObserver(ROBUST, setup)
