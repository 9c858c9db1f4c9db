"""Bytes of messages: CDR of ROS 2, and the serialisation of ROS 1, both by rosbags."""

from functools import cache
from typing import Any

from coopenv.errors import CoopenvError
from coopenv.svea.definitions import ROS_1, ROS_2

MOST_BYTES = 65_536
"""Of one message: a frame of a camera with 7 colours has hundreds of bytes, and nothing here has images."""


@cache
def ros2() -> Any:
    """Return the store of ROS 2 types, ours and the cars' among them. Raises CoopenvError: no extra."""
    return _store("ROS2_JAZZY", ROS_2)


@cache
def ros1() -> Any:
    """Return the store of ROS 1 types, likewise."""
    return _store("ROS1_NOETIC", ROS_1)


def _store(name: str, definitions: dict[str, str]) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise CoopenvError("messages of cars need an extra: pip install '.[svea]'") from None
    store = get_typestore(Stores[name])
    for kind, text in definitions.items():
        store.register(get_types_from_msg(text, kind))
    return store


def make(kind: str, **fields: Any) -> Any:
    """Return a ROS 2 message of a type by its fields."""
    return ros2().types[kind](**fields)


def header(stamp: int, frame: str = "") -> Any:
    """Return a header with a stamp in ns."""
    return make("std_msgs/msg/Header", stamp=make_time(stamp), frame_id=frame)


def make_time(stamp: int) -> Any:
    """Return a time in ns as a message."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def stamp_of(message: Any) -> int:
    """Return the stamp in ns of a message with a header, of ROS 1 or 2."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def encode(message: Any) -> bytes:
    """Return the CDR bytes of a message, its 4 bytes of encapsulation included."""
    return bytes(ros2().serialize_cdr(message, message.__msgtype__))


def decode(payload: bytes, kind: str) -> Any:
    """Return the message of CDR bytes.

    Raises:
        CoopenvError: they are not a message of that type, or too long.
    """
    return _decoded(ros2().deserialize_cdr, payload, kind)


def encode_ros1(message: Any) -> bytes:
    """Return the ROS 1 bytes of a message."""
    return bytes(ros1().serialize_ros1(message, message.__msgtype__))


def decode_ros1(payload: bytes, kind: str) -> Any:
    """Return the message of ROS 1 bytes; errors as for `decode`."""
    return _decoded(ros1().deserialize_ros1, payload, kind)


def _decoded(read: Any, payload: bytes, kind: str) -> Any:
    if len(payload) > MOST_BYTES:
        raise CoopenvError(f"{kind}: {len(payload)} bytes are over {MOST_BYTES}")
    try:
        return read(payload, kind)
    except Exception as error:  # whatever the library raises at bytes that make no sense
        raise CoopenvError(f"{kind}: cannot be read ({type(error).__name__})") from None
