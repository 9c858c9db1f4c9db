"""Names, types and freshness of the topics of a car, under `fleet/CAR/` (ROS names without the leading slash)."""

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What a topic tells."""

    DETECTIONS = "detections"  # blocks of the Pixy, pixels
    BEARINGS = "bearings"  # of the Pixy, unit vectors from the target to the camera, optical frame
    CAMERA_INFO = "camera_info"
    ODOMETRY = "odometry"  # of the car's own filter
    WHEEL = "wheel"
    IMU = "imu"
    ESTIMATE = "estimate"  # V2X
    REPORT = "report"  # V2X, of the observer `robust`
    POINT = "point"  # V2X of the authors: a position alone
    TRUTH = "truth"  # motion capture
    STATE = "state"
    REMOTE = "remote"  # what the remote control sends
    BATTERY = "battery"
    COMMAND = "command"  # to the gate
    ARM = "arm"  # likewise
    GATE = "gate"  # what the gate says of itself
    STOP = "stop"
    MANUAL = "manual"  # what the gate sends to the car


@dataclass(frozen=True)
class Topic:
    """A topic of a car."""

    suffix: str
    type: str  # ROS 2 name
    max_age: float | None = None  # s; older ones do not count
    urgent: bool = False  # sent at once and before others
    reliable: bool = False  # the sender waits rather than drops


TOPICS = {
    Role.DETECTIONS: Topic("pixy/objects_info", "pixy_camera/msg/ObjectInfoArrayStamped", 0.05, urgent=True),
    Role.BEARINGS: Topic("pixy/objects_bearing", "pixy_camera/msg/ObjectBearingArrayStamped", 0.05, urgent=True),
    Role.CAMERA_INFO: Topic("pixy/camera_info", "sensor_msgs/msg/CameraInfo"),
    Role.ODOMETRY: Topic("odometry/local", "nav_msgs/msg/Odometry", 0.2),
    Role.WHEEL: Topic("mavros/wheel_odometry/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", 0.1, True),
    Role.IMU: Topic("mavros/imu/data_raw", "sensor_msgs/msg/Imu", 0.1),
    Role.ESTIMATE: Topic("v2x/estimate", "geometry_msgs/msg/PoseWithCovarianceStamped", 0.25),
    Role.REPORT: Topic("v2x/robust", "coopenv_msgs/msg/RobustReport", 0.25),
    Role.POINT: Topic("v2x/point", "geometry_msgs/msg/PointStamped", 0.25),
    Role.STATE: Topic("mavros/state", "mavros_msgs/msg/State", 2.0),
    Role.REMOTE: Topic("mavros/rc/in", "mavros_msgs/msg/RCIn", 2.0),
    Role.BATTERY: Topic("mavros/battery", "sensor_msgs/msg/BatteryState", 2.0),
    Role.COMMAND: Topic("coopenv/cmd", "ackermann_msgs/msg/AckermannDriveStamped", 0.15, urgent=True),
    Role.ARM: Topic("coopenv/arm", "coopenv_msgs/msg/Arm", 0.15, reliable=True),
    Role.GATE: Topic("coopenv/gate", "coopenv_msgs/msg/GateStatus", 0.5),
    Role.STOP: Topic("coopenv/estop", "std_msgs/msg/Bool", urgent=True, reliable=True),
    Role.MANUAL: Topic("mavros/manual_control/send", "mavros_msgs/msg/ManualControl", urgent=True),
    Role.TRUTH: Topic("odom", "nav_msgs/msg/Odometry", 0.1),
}
"""Those under `fleet/CAR/`; the truth is under `fleet/qualisys/CAR/`."""

PREFIX = "fleet"
MOTION_CAPTURE = "qualisys"
TICK_TOPIC = "coopenv/tick"  # in files only
STOPPED_TOPIC = "coopenv/stopped"  # likewise: why the watchdog stopped the cars
RESET_TOPIC = "fleet/coopenv/reset"  # std_msgs/msg/Int64, a seed: fakes go to their start


def topic_of(car: str, role: Role) -> str:
    """Return the full name of a car's topic, which is its Zenoh key as well."""
    middle = f"{MOTION_CAPTURE}/{car}" if role is Role.TRUTH else car
    return f"{PREFIX}/{middle}/{TOPICS[role].suffix}"


def presence_of(name: str) -> str:
    """Return the key of the liveliness token of a car, its gate or an environment."""
    return f"{PREFIX}/alive/{name}"
