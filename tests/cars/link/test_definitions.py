"""Types: their checksums are those that the cars' own software computes."""

from __future__ import annotations

import pytest

from coopenv.cars.codec import ros1, ros2
from coopenv.cars.profile import SVEA

MD5 = {
    "svea_msgs/msg/lli_ctrl": "f4c1d25e08fe7c24fca84a1ec3ad2a96",
    "svea_msgs/msg/VehicleState": "63c01f5a2a38c7ae477ab5ec3d89c8c3",
    "pixy_camera/msg/ObjectBearingArrayStamped": "390db9f9b054c1851184795495a51256",
    "nav_msgs/msg/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "geometry_msgs/msg/PointStamped": "c63aecb41bfdfd6b7e1fac37c7cbe7bf",
}
"""Of ROS 1, from genpy on the authors' stack."""

RIHS01 = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}
"""Of ROS 2 Jazzy, as published."""


@pytest.mark.parametrize("kind", MD5)
def test_checksums_of_ros1_are_those_of_the_cars(kind: str) -> None:
    assert ros1().generate_msgdef(kind)[1] == MD5[kind]


@pytest.mark.parametrize("kind", RIHS01)
def test_hashes_of_ros2_are_the_published_ones(kind: str) -> None:
    assert ros2().hash_rihs01(kind) == f"RIHS01_{RIHS01[kind]}"


def test_every_topic_has_a_type() -> None:
    assert {topic.type for topic in SVEA.topics.values()} <= set(ros2().types)
