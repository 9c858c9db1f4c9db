"""Names of topics: those of the cars, and of the bridge."""

from __future__ import annotations

import pytest

from coopenv.cars.profile import SVEA, Role, presence_of
from coopenv.cars.transport.base import matcher

NAMES = {
    Role.ODOMETRY: ("fleet/svea7/odometry/local", "nav_msgs/msg/Odometry", 0.2),
    Role.WHEEL: ("fleet/svea7/mavros/wheel_odometry/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", 0.1),
    Role.IMU: ("fleet/svea7/mavros/imu/data_raw", "sensor_msgs/msg/Imu", 0.1),
    Role.BEARINGS: ("fleet/svea7/pixy/objects_bearing", "pixy_camera/msg/ObjectBearingArrayStamped", 0.05),
    Role.CAMERA_INFO: ("fleet/svea7/pixy/camera_info", "sensor_msgs/msg/CameraInfo", None),
    Role.ESTIMATE: ("fleet/svea7/v2x/estimate", "geometry_msgs/msg/PoseWithCovarianceStamped", 0.25),
    Role.STATE: ("fleet/svea7/mavros/state", "mavros_msgs/msg/State", 2.0),
    Role.REMOTE: ("fleet/svea7/mavros/rc/in", "mavros_msgs/msg/RCIn", 2.0),
    Role.BATTERY: ("fleet/svea7/mavros/battery", "sensor_msgs/msg/BatteryState", 2.0),
    Role.COMMAND: ("fleet/svea7/coopenv/cmd", "ackermann_msgs/msg/AckermannDriveStamped", 0.15),
    Role.MANUAL: ("fleet/svea7/mavros/manual_control/send", "mavros_msgs/msg/ManualControl", None),
    Role.STOP: ("fleet/svea7/coopenv/estop", "std_msgs/msg/Bool", None),
    Role.TRUTH: ("fleet/qualisys/svea7/odom", "nav_msgs/msg/Odometry", 0.1),
}


@pytest.mark.parametrize("role", NAMES)
def test_names_types_and_ages_are_those_agreed(role: Role) -> None:
    name, kind, age = NAMES[role]
    assert SVEA.topic_of("svea7", role) == name
    assert (SVEA.topics[role].type, SVEA.topics[role].max_age) == (kind, age)


def test_commands_overtake_and_a_stop_waits_rather_than_is_lost() -> None:
    assert SVEA.topics[Role.COMMAND].urgent
    assert SVEA.topics[Role.STOP].urgent
    assert SVEA.topics[Role.STOP].reliable


def test_no_two_topics_have_one_name() -> None:
    names = [SVEA.topic_of(car, role) for car in ("svea1", "svea7") for role in SVEA.topics]
    assert len(set(names)) == len(names)


def test_the_pattern_of_all_presences_matches_each() -> None:
    assert matcher(presence_of("*"))(presence_of("svea7"))
