"""Vehicles of highway-env's traffic.

Environments of highway-env set parameters of the class of their traffic, and with it those of every other environment
in the process. Classes of our own keep worlds of one program from changing one another.
"""

from highway_env.vehicle.behavior import IDMVehicle


class IntersectionTraffic(IDMVehicle):  # type: ignore[misc]
    """Traffic whose parameters its environment sets at each reset, always the same."""


class Traffic(IDMVehicle):  # type: ignore[misc]
    """Traffic with highway-env's own parameters, whatever others have made of their class."""

    DISTANCE_WANTED = 5.0 + IDMVehicle.LENGTH  # m
    COMFORT_ACC_MAX = 3.0  # m/s^2
    COMFORT_ACC_MIN = -5.0  # m/s^2
