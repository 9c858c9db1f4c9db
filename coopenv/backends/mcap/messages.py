"""The messages of a recording and their CDR codec; a message's tick is its sequence number.

Standard ROS 2 messages are there for viewers; what is read back stands in messages of our own, in full precision.
"""

from functools import cache
from typing import Any

from coopenv.base.errors import CoopenvError

FORMAT = "coopenv recording 1"
ATTACHMENT = "recording.json"
LANDMARKS = "/landmarks"

DEFINITIONS = {
    "coopenv_msgs/msg/Odometry": """
std_msgs/Header header
float64[9] rotation  # increment over the tick, row by row: R <- R dR
float64[3] translation  # m, body frame at the tick's start: p <- p + R dp
float64[3] velocity  # m/s, last sample, body frame
float64[3] angular_velocity  # rad/s
""",
    "coopenv_msgs/msg/Bearings": """
std_msgs/Header header
bool due  # a correction is due at this frame
uint32[] targets  # landmarks first, then vehicles; see recording.json
bool[] visible
float64[] vectors  # x, y, z per target: unit vector camera -> target, body frame
""",
    "coopenv_msgs/msg/Inbox": """
std_msgs/Header header
int64[] tick_sent  # per sender: when the last message heard was sent; -1: none
""",
    "coopenv_msgs/msg/Pan": """
std_msgs/Header header
float64[1] angle  # rad, by which the camera is turned to the left
""",
    "coopenv_msgs/msg/Truth": """
std_msgs/Header header
float64[9] rotation  # body to map, row by row; NaN: not known
float64[3] position  # m, map
""",
}

PAN = {"pan": "coopenv_msgs/msg/Pan"}
"""A further topic of a vehicle, where cameras pan."""

EXACT = {
    "increment": "coopenv_msgs/msg/Odometry",
    "bearings": "coopenv_msgs/msg/Bearings",
    "v2x": "coopenv_msgs/msg/Inbox",
    "truth_exact": "coopenv_msgs/msg/Truth",
}
"""Topics of a vehicle that hold the recording, one message a tick."""

CONTENTS = {
    "increment": {name: name for name in ("rotation", "translation", "velocity", "angular_velocity")},
    "bearings": {},
    "pan": {"angle": "pan"},
    "v2x": {"tick_sent": "inbox_tick"},
    "truth_exact": {"rotation": "truth.rotation", "position": "truth.position"},
}
"""Topic to the entries of its messages that hold a vehicle's row of an array of the `Recording`; of bearings only those
that there are hold any."""

SHOWN = {"odometry": "nav_msgs/msg/Odometry", "truth": "geometry_msgs/msg/PoseStamped"}
"""Topics of a vehicle that viewers understand: dead reckoning from the start, and the truth where it is known."""

LANDMARKS_TYPE = "geometry_msgs/msg/PoseArray"
"""Type of the topic `LANDMARKS`: positions in the map, one message whenever one has changed."""


def topic(vehicle: str, name: str) -> str:
    """Return the full name of a vehicle's topic."""
    return f"/{vehicle}/{name}"


@cache
def codec() -> Any:
    """Return the store of message types, with ours in it. Raises CoopenvError: the extra is not installed."""
    try:
        import mcap  # noqa: F401
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise CoopenvError("MCAP files need an extra: pip install '.[log]'") from None
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store
