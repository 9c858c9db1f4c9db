"""Bytes of messages: CDR of ROS 2, and the serialisation of ROS 1, both by rosbags."""

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command, message_types, needing
from coopenv.cars.link.transport import MOST_BYTES
from coopenv.cars.settings.profile import IMAGES, SVEA, CarProfile

TICK = "coopenv_msgs/msg/Tick"
"""Type of the marks in a file of a drive."""

STOPPED = "coopenv_msgs/msg/Stopped"
"""Type of the message there with the reason for which the watchdog stopped the cars."""

MOST_FRAME = 2**25
"""Bytes of a frame of a camera."""


@cache
def ros2() -> Any:
    """Return the store of ROS 2 types, ours and the cars' among them. Raises CoopenvError: no extra."""
    return _store("ROS2_JAZZY")


@cache
def ros1() -> Any:
    """Return the store of ROS 1 types, likewise."""
    return _store("ROS1_NOETIC")


def _store(name: str) -> Any:
    with needing(f"messages of cars need an extra: {install_command('svea')}"):
        return message_types(name)


def numbers_after_header(kind: str) -> list[str]:
    """Return the types of the numbers of a stamped message in their order; none: it is unknown, or holds others."""

    def numbers(of: str) -> Iterator[str]:
        for _, (node, part) in ros2().fielddefs[of][1]:
            if node.name == "NAME":
                yield from numbers(part)
            else:
                yield part[0] if node.name == "BASE" else node.name

    fields = ros2().fielddefs.get(kind, ("", []))[1]
    if not fields or fields[0][1][1] != "std_msgs/msg/Header":
        return []
    return [*numbers(kind)][len([*numbers("std_msgs/msg/Header")]) :]


def make(kind: str, **fields: Any) -> Any:
    """Return a ROS 2 message of a type by its fields; those that are not given are zero and empty.

    A message within it may be given by its fields, as a dictionary or in their order: a vector as (x, y, z).
    """
    made, zeros, parts = _type(kind)
    for name, value in parts:
        fields[name] = value(fields.get(name))
    return made(**{**zeros, **fields})


@cache
def _type(kind: str) -> tuple[Any, dict[str, Any], list[tuple[str, Callable[[Any], Any]]]]:
    """Return the class of a type, the zeros of its numbers and texts, and what makes its other fields."""
    store, zeros, parts = ros2(), dict[str, Any](), []
    for name, node in store.fielddefs[kind][1]:
        if node[0].name == "BASE":
            zeros[name] = "" if node[1][0] == "string" else np.zeros(1, dtype=node[1][0])[0].item()
        else:
            parts.append((name, _field(node)))
    return store.types[kind], zeros, parts


def _field(node: Any) -> Callable[[Any], Any]:
    """Return the constructor of a message or a list within a message; `node` is the field as rosbags describes it."""
    kind, of = node
    if kind.name == "NAME":
        names = [name for name, _ in ros2().fielddefs[of][1]]

        def nested(given: Any) -> Any:
            if given is None or isinstance(given, dict):
                return make(of, **(given or {}))
            if isinstance(given, np.ndarray):
                given = given.tolist()
            return make(of, **dict(zip(names, given, strict=True))) if isinstance(given, tuple | list) else given

        return nested
    (name, element), length = of[0], of[1] if kind.name == "ARRAY" else 0
    if name.name == "NAME":
        part = _field(of[0])
        return lambda given: [part(entry) for entry in given or [None] * length]
    if element[0] == "string":
        return lambda given: given or [""] * length
    dtype = np.dtype(element[0])
    return lambda given: np.zeros(length, dtype) if given is None else np.asarray(given, dtype).ravel()


def header(stamp: int, frame: str = "") -> Any:
    """Return a header with a stamp in ns."""
    return make("std_msgs/msg/Header", stamp=divmod(stamp, 10**9), frame_id=frame)


def stamp_of(message: Any) -> int:
    """Return the stamp in ns of a message of ROS 1 or 2; 0: it has no header."""
    if not hasattr(message, "header"):
        return 0
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


def ros1_of(payload: bytes, kind: str) -> bytes:
    """Return the ROS 1 bytes of a message in CDR, with 0 as the `seq` of its header; errors as for `decode`."""
    return bytes(_decoded(ros2().cdr_to_ros1, payload, kind))


def cdr_of(payload: bytes, kind: str) -> bytes:
    """Return the CDR bytes of a message in ROS 1 bytes; errors as for `decode`."""
    return bytes(_decoded(ros2().ros1_to_cdr, payload, kind))


def _decoded(read: Any, payload: bytes, kind: str) -> Any:
    if len(payload) > (most := MOST_FRAME if kind in IMAGES else MOST_BYTES):
        raise CoopenvError(f"{kind}: {len(payload)} bytes are over {most}")
    try:
        return read(payload, kind)
    except Exception as error:  # any error of the library at malformed bytes
        raise CoopenvError(f"{kind}: cannot be read ({type(error).__name__})") from None


def pose(rotation: Any, position: Any) -> Any:
    """Return a geometry_msgs/Pose of a rotation (3, 3), body to map, and a position (3,), m."""
    from scipy.spatial.transform import Rotation  # the extra `gate` has no SciPy

    return make("geometry_msgs/msg/Pose", position=position, orientation=Rotation.from_matrix(rotation).as_quat())


def warm_up(profile: CarProfile = SVEA) -> None:
    """Encode and decode one message of every type, which compiles the codec."""
    for topic in profile.topics.values():
        decode(encode(make(topic.type)), topic.type)
