"""Rows of the zoo: observers for robots on a plane."""

from coopenv.observers.registry import ZooEntry

PLANAR_EKF = ZooEntry("planar:PlanarEkf", package=__package__, in_space=False)
PLANAR_ROBUST = ZooEntry("planar:PlanarRobust", package=__package__, in_space=False, of_robots=True)
