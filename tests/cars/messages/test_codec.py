"""Messages as bytes, and commands as a car's actuation takes them."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand, read_drive, write_drive
from coopenv.cars.link.ros1 import low_level
from coopenv.cars.messages.codec import MOST_BYTES, cdr_of, decode, encode, header, make, ros1, ros1_of, ros2
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, Role

ENCAPSULATION = bytes.fromhex("00010000")
MANUAL = "mavros_msgs/msg/ManualControl"
ODOMETRY = "nav_msgs/msg/Odometry"
POINT = "geometry_msgs/msg/PointStamped"


def odometry() -> Any:
    return make(
        ODOMETRY,
        header=header(1_000_000_002, "svea7/odom"),
        child_frame_id="svea7/base_link",
        pose={"pose": ((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8)), "covariance": np.arange(36.0)},
        twist={"twist": ((0.5, 0.0, 0.0), (0.0, 0.0, 0.1))},
    )


def test_a_manual_control_is_these_bytes() -> None:
    stamp = struct.pack("<iI", 3, 4)
    frame = struct.pack("<I", 1) + b"\0" + bytes(3)
    axes = struct.pack("<4f", 0.0, -286.48, 382.35, 0.0)
    bits = struct.pack("<HHB", 0, 0, 252) + bytes(3)
    rest = struct.pack("<8f", 0.0, 0.0, -1000.0, -1000.0, 1000.0, 0.0, 0.0, 0.0)
    aux = {"aux1": -1000.0, "aux2": -1000.0, "aux3": 1000.0}
    manual = make(MANUAL, header=header(3_000_000_004), y=-286.48, z=382.35, enabled_extensions=252, **aux)
    assert encode(manual) == ENCAPSULATION + stamp + frame + axes + bits + rest


@pytest.mark.parametrize("read", [decode, cdr_of, ros1_of])
@pytest.mark.parametrize("payload", [b"", b"\0\1\0\0", bytes(MOST_BYTES + 1)])
def test_bytes_that_are_no_message_are_refused_in_one_line(read: Any, payload: bytes) -> None:
    with pytest.raises(CoopenvError, match=r"^nav_msgs/msg/Odometry: [^\n]+$"):
        read(payload, ODOMETRY)


@given(payload=st.binary(max_size=200))
def test_random_bytes_are_refused_or_read(payload: bytes) -> None:
    for read in (decode, cdr_of, ros1_of):
        try:
            assert read(payload, MANUAL if read is decode else POINT) is not None
        except CoopenvError as error:
            assert "\n" not in str(error)


MD5 = {
    "svea_msgs/msg/lli_ctrl": "f4c1d25e08fe7c24fca84a1ec3ad2a96",
    "pixy_camera/msg/ObjectBearingArrayStamped": "390db9f9b054c1851184795495a51256",
    "nav_msgs/msg/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "geometry_msgs/msg/PointStamped": "c63aecb41bfdfd6b7e1fac37c7cbe7bf",
}
"""Of ROS 1, from genpy on the authors' stack."""


@pytest.mark.parametrize("kind", MD5)
def test_checksums_of_ros1_are_those_of_the_cars(kind: str) -> None:
    assert ros1().generate_msgdef(kind)[1] == MD5[kind]


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


STEERING = st.floats(-math.radians(36.0), math.radians(36.0))
SPEED = st.floats(-1.53, 1.53)
COMMAND = SVEA.command


@pytest.mark.parametrize(
    ("steering", "speed", "y", "z"),
    [(0.0, 0.0, 0.0, 500.0), (0.2, 0.4, -286.48, 382.35), (-0.2, -0.4, 286.48, 617.65), (1.0, 3.0, -900.0, 50.0)],
)
def test_manual_control_has_the_values_of_the_cars_interface(steering: float, speed: float, y: float, z: float) -> None:
    fields = COMMAND.values(MotionCommand(steering, speed))
    assert (fields["y"], fields["z"]) == pytest.approx((y, z), abs=0.005)
    back = COMMAND.drive({"y": y, "z": z})
    cut = MotionCommand(min(max(steering, -0.2 * math.pi), 0.2 * math.pi), min(max(speed, -1.53), 1.53))
    assert (back.steering, back.speed) == pytest.approx((cut.steering, cut.speed), abs=2e-5)


def test_manual_control_names_its_extensions() -> None:
    fields = COMMAND.values(NEUTRAL)
    assert fields["enabled_extensions"] == sum(1 << bit for bit in range(2, 8)) == 252
    assert [fields[f"aux{i}"] for i in range(1, 7)] == [-1000, 1000, 1000, 1000, 1000, 0]
    assert not any(fields[name] for name in ("x", "y", "r", "s", "t", "buttons", "buttons2"))
    names = [name for name in ros2().types[SVEA.topics[Role.MANUAL].type].__annotations__ if name[0] != "_"]
    assert names[1:] == list(COMMAND.neutral)


@given(STEERING, SPEED)
def test_manual_control_comes_back(steering: float, speed: float) -> None:
    payload = write_drive(0, COMMAND, MotionCommand(steering, speed))
    fields = decode(payload, SVEA.topics[Role.MANUAL].type)
    assert abs(fields.y) <= 900.001 and 49.999 <= fields.z <= 950.001
    back = read_drive(payload, COMMAND)
    assert (back.steering, back.speed) == pytest.approx((steering, speed), abs=1e-6)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_no_command_goes_beyond_ninety_per_cent(steering: float, speed: float) -> None:
    fields, low = COMMAND.values(MotionCommand(steering, speed)), low_level(MotionCommand(steering, speed), COMMAND)
    assert abs(fields["y"]) <= 900.0 and 50.0 <= fields["z"] <= 950.0
    assert abs(low.steering) <= 114 and abs(low.velocity) <= 116


def test_low_level_has_the_values_of_the_cars_interface() -> None:
    # At 90 %: 0.85 * 90 + 15 = 91.5.
    for wanted, expected in (((0.2, 0.8), (36, 70)), ((1.0, 3.0), (114, 116)), ((-1.0, -3.0), (-114, -116))):
        fields = low_level(MotionCommand(*wanted), COMMAND)
        assert (fields.steering, fields.velocity) == expected
    still = low_level(NEUTRAL, COMMAND)
    assert (still.steering, still.velocity, still.trans_diff, still.ctrl) == (0, 0, 0b111000, 0)
    least = low_level(MotionCommand(speed=0.018), COMMAND).velocity  # 1 %
    assert least == round(1.27 * 15.85) == -low_level(MotionCommand(speed=-0.018), COMMAND).velocity
    assert low_level(MotionCommand(speed=0.0169), COMMAND).velocity == 0


@given(st.tuples(SPEED, STEERING), st.tuples(SPEED, STEERING), st.floats(0.0, 1.0))
def test_rates_are_limited(before: tuple[float, float], wanted: tuple[float, float], dt: float) -> None:
    limits = Limits(0.5, 0.5, 1.0, 2.0)
    after = limits.approach(before, wanted, dt)
    for old, goal, new, rate in zip(before, wanted, after, (1.0, 2.0), strict=True):
        assert abs(new - old) <= rate * dt + 1e-12
        assert abs(goal - new) <= abs(goal - old)  # never away from it, nor beyond
        assert new == goal or abs(new - old) == pytest.approx(rate * dt)


@pytest.mark.parametrize("limits", [Limits(1.6, 0.5, 1.0, 2.0), Limits(0.5, 0.6, 1, 2), Limits(0.5, 0.5, 0.0, 2)])
def test_limits_beyond_the_hardest_are_refused(limits: Limits) -> None:
    assert SVEA.hardest.check(SVEA.hardest) is SVEA.hardest
    with pytest.raises(CoopenvError, match="must be above 0, at most"):
        limits.check(SVEA.hardest)
    with pytest.raises(CoopenvError, match="does not reverse"):
        replace(SVEA.hardest, reverse=True).check(replace(SVEA.hardest, reverse=False))
