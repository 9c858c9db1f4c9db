"""Decoders of a bag's messages, by the definition that the bag brings or by ours, within limits.

A definition is made by a stranger. It counts if it parses and if a message by it cannot be much larger in memory than
in the file. Our own definition of the type, if there is one, replaces a definition that is of no use. Definitions of
channels that are not read are never parsed.
"""

import re
import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from coopenv.base.errors import CoopenvError
from coopenv.cars.messages import codec
from coopenv.cars.messages.readings import OTHER_FIELDS
from coopenv.cars.messages.vision import frame_of
from coopenv.cars.settings.profile import IMAGE

CDR, ROS1 = "cdr", "ros1"
"""Encodings of messages that are read."""
REFUSED = "refused"
"""In place of the encoding of a message that the reader process has refused; its bytes are the reason."""
MOST_TEXT = 2**17  # characters; the largest definitions of ROS, nested ones included, have some 60,000
MOST_OBJECTS, MOST_FIXED = 300_000, 1_000
"""Python objects that a message may become, some 100 MB, and those of a type without its sequences."""
FILLER = "structure_needs_at_least_one_member"
"""Field that rosbags puts into empty types; it has no bytes in ROS 1."""


class BagChannel(NamedTuple):
    """A channel of a bag: a topic, with the type and the encoding of its messages."""

    topic: str
    kind: str  # its type, such as sensor_msgs/msg/Imu
    encoding: str  # of its messages: CDR, ROS1, or another one, which is not read
    language: str = ""  # of its definition: ros1msg, ros2msg, ros2idl
    definition: str = ""

    @property
    def readable(self) -> bool:
        """Whether its messages are in an encoding that is read."""
        return self.encoding in (CDR, ROS1)


class _Cost(NamedTuple):
    """Size of a field in a message."""

    least: int  # bytes
    objects: int  # Python objects without those of sequences
    per_byte: float  # Python objects of sequences per byte of the message, at most


def decode(channel: BagChannel, data: bytes) -> Any:
    """Return a message of a channel.

    Raises:
        CoopenvError: the bytes are no message, or may be one of more objects than `MOST_OBJECTS`, or the type has no
            usable definition.
    """
    if channel.encoding == REFUSED:
        raise CoopenvError(data.decode())
    store, cost, why = _store(channel)
    if cost.objects + cost.per_byte * len(data) > MOST_OBJECTS:
        raise CoopenvError(f"{channel.kind}: {len(data)} bytes may hold over {MOST_OBJECTS} values")
    try:
        return (store.deserialize_ros1 if channel.encoding == ROS1 else store.deserialize_cdr)(data, channel.kind)
    except Exception as error:  # any error of the library at malformed bytes
        raise CoopenvError(f"{channel.kind}: cannot be read ({type(error).__name__}){why}") from None


def with_raw_frame(channel: BagChannel, received: int, data: bytes, colours: bool) -> tuple[BagChannel, int, bytes]:
    """Return a CompressedImage of a channel as an Image in CDR, with colours or in shades of grey."""
    try:
        message = decode(channel, data)
        frame = frame_of(message, "BGR" if colours else "GRAY")
        about = codec.header(codec.stamp_of(message), str(message.header.frame_id))
    except (CoopenvError, *OTHER_FIELDS) as error:
        return channel._replace(encoding=REFUSED), received, str(error).encode()
    height, width = frame.shape[:2]
    layout = {"height": height, "width": width, "encoding": "bgr8" if colours else "mono8", "step": frame.strides[0]}
    raw = codec.encode(codec.make(IMAGE, header=about, data=frame, **layout))
    return BagChannel(channel.topic, IMAGE, CDR), received, raw


def stamp(channel: BagChannel, data: bytes) -> int:
    """Return the stamp (ns) of a message that is not decoded; 0: none."""
    if not _has_header(channel) or len(data) < 12:
        return 0
    order = "<" if channel.encoding == ROS1 or data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}II", data, 4)  # after the encapsulation, or seq of ROS 1
    return int(seconds) * 10**9 + int(nanoseconds)


@lru_cache(maxsize=4096)
def _has_header(channel: BagChannel) -> bool:
    """Return whether a channel's messages begin with a Header, by our definition or by the text of its own."""
    if channel.kind in (known := _known(channel).fielddefs):
        return "std_msgs/msg/Header" in str(known[channel.kind][1][:1])
    lines = (line.partition("#")[0].strip() for line in channel.definition[:MOST_TEXT].splitlines())
    first = next((line for line in lines if line and "=" not in line), "")
    return re.match(r"(std_msgs/(msg/)?)?Header\s", first) is not None


def _known(channel: BagChannel) -> Any:
    return codec.ros1() if channel.encoding == ROS1 else codec.ros2()


@lru_cache(maxsize=128)
def _store(channel: BagChannel) -> tuple[Any, _Cost, str]:
    """Return a store with a channel's type, the size of that, and why its own definition is not used, or nothing.

    Raises CoopenvError: it is not used, and there is none of ours.
    """
    known, kind = _known(channel), channel.kind
    try:
        found = _parsed(channel)
        store = get_typestore(Stores.EMPTY)
        if all(known.fielddefs.get(name) == fields for name, fields in found.items()):
            store = known  # which is compiled already
        else:
            store.register(found)
            if {*re.findall(r"[\w/]+/msg/\w+", str(found))} - found.keys():
                store.register({name: known.fielddefs[name] for name in known.fielddefs.keys() - found.keys()})
        return store, _cost(store.fielddefs, kind), ""
    except Exception as error:  # any error of the library at a malformed definition
        cause = error if isinstance(error, CoopenvError) else "it does not parse"
        why = f"its definition in the bag is of no use: {cause}"
        if kind not in known.fielddefs:
            raise CoopenvError(f"{kind}: {why}") from None
        return known, _cost(known.fielddefs, kind), f"; {why}" if channel.definition else ""


def _parsed(channel: BagChannel) -> dict[str, Any]:
    """Return the types of a channel's definition. Raises an error of the library, or CoopenvError: it is too long."""
    text = re.sub(r"\n\s*\n", "\n", channel.definition.replace("\r\n", "\n"))
    if not text.strip() or len(text) > MOST_TEXT:
        raise CoopenvError(f"more than {MOST_TEXT} characters" if text.strip() else "it is empty")
    if channel.language != "ros2idl":
        return dict(get_types_from_msg(text, channel.kind))
    parts = re.split(r"^=+\nIDL: .*\n", text, flags=re.MULTILINE)
    return {name: fields for part in parts if part.strip() for name, fields in get_types_from_idl(part).items()}


def _cost(types: Mapping[str, Any], kind: str) -> _Cost:
    """Return the size of a type. Raises CoopenvError: it contains itself, is too large, or has an unknown part."""
    found: dict[str, _Cost | None] = {}  # None: its parts are being looked at

    def of_type(name: str) -> _Cost:
        if name not in found:
            if name not in types:
                raise CoopenvError(f"{name} is not defined")
            found[name] = None
            parts = [of_field(node) for field, node in types[name][1] if field != FILLER]
            objects = 1 + sum(part.objects for part in parts)
            if objects > MOST_FIXED:
                raise CoopenvError(f"{name} has over {MOST_FIXED} values")
            found[name] = _Cost(sum(p.least for p in parts), objects, max((p.per_byte for p in parts), default=0.0))
        if (cost := found[name]) is None:
            raise CoopenvError(f"{name} contains itself")
        return cost

    def of_field(node: Any) -> _Cost:
        what, of = node
        if what == Nodetype.NAME:
            return of_type(of)
        if what == Nodetype.BASE:
            return _Cost(SIZEMAP.get(of[0], 4), 1, 0.0)
        element, count = of
        least, objects, per_byte = of_field(element)
        if element[0] == Nodetype.BASE and element[1][0] in SIZEMAP:  # one array of NumPy
            return _Cost(count * least if what == Nodetype.ARRAY else 4, 1, 0.0)
        if what == Nodetype.ARRAY:
            return _Cost(count * least, 1 + count * objects, per_byte)
        if least == 0:
            raise CoopenvError("it has a sequence of values without bytes")
        return _Cost(4, 1, max(per_byte, objects / least))

    return of_type(kind)
