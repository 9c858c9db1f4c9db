"""ROS bags of any laboratory as a backend: a map gives car and content of each topic."""

from coopenv.cars.bags.backend import Bag

__all__ = ["Bag"]
