"""One message in the words of ROS 1 and of ROS 2, field by field."""

from typing import Any

import numpy as np

from coopenv.svea.codec import make, ros1, ros2


def to_ros1(message: Any) -> Any:
    """Return a ROS 2 message as the ROS 1 message of the same type; its header's `seq` is 0."""
    return _converted(ros1(), message, message.__msgtype__)


def to_ros2(message: Any) -> Any:
    """Return a ROS 1 message as the ROS 2 message of the same type."""
    return _converted(ros2(), message, message.__msgtype__)


def point_of(message: Any) -> Any:
    """Return the position of a ROS 2 PoseWithCovarianceStamped as a ROS 1 PointStamped."""
    position = message.pose.pose.position
    return to_ros1(make("geometry_msgs/msg/PointStamped", header=message.header, point=position))


def _converted(store: Any, message: Any, kind: str) -> Any:
    values = {name: _value(store, node, _field(message, name)) for name, node in store.fielddefs[kind][1]}
    return store.types[kind](**values)


def _field(message: Any, name: str) -> Any:
    """Return a field; ROS 1 writes the matrices of cameras large, ROS 2 small, and only ROS 1 counts headers."""
    if name == "seq":
        return 0
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.swapcase())


def _value(store: Any, node: Any, value: Any) -> Any:
    """Return a field's value in the types of a store; `node` is the field as rosbags describes it."""
    kind, of = node
    if kind.name == "NAME":
        return _converted(store, value, of)
    if kind.name == "BASE" or isinstance(value, np.ndarray):
        return value
    return [_value(store, of[0], element) for element in value]
