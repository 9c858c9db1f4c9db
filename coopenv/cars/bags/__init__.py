"""ROS bags of any laboratory as a backend: a map says which topic tells what of which car."""

from coopenv.cars.bags.backend import Bag

__all__ = ["Bag"]
