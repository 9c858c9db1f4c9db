"""The gate's few messages as CDR, without a library; `coopenv.cars.codec` has all messages of cars."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError

if TYPE_CHECKING:
    from coopenv.cars.profile import CommandMessage, Drive

ENCAPSULATION = b"\0\1\0\0"
LONGEST_PADDING = 3  # bytes after the last field, which some writers add


class Malformed(CoopenvError):  # noqa: N818
    """Bytes are not the message that they should be."""


class Reader:
    """Takes one field after the other; every method raises Malformed where the bytes end too soon."""

    def __init__(self, payload: bytes) -> None:
        if payload[:2] != ENCAPSULATION[:2] or len(payload) < len(ENCAPSULATION):
            raise Malformed("no little-endian CDR")
        self._body = payload[len(ENCAPSULATION) :]
        self._place = 0

    def take(self, kind: str) -> Any:
        """Return a number of a kind of the module struct."""
        size = struct.calcsize(kind)
        start = -(-self._place // size) * size
        self._place = start + size
        if self._place > len(self._body):
            raise Malformed("too short")
        return struct.unpack_from(f"<{kind}", self._body, start)[0]

    def text(self) -> str:
        """Return a text: its length with the zero byte at its end, its bytes, the zero byte."""
        length = self.take("I")
        raw = self._body[self._place : self._place + length]
        self._place += length
        if len(raw) != length or raw[-1:] != b"\0":
            raise Malformed("a text has no end")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise Malformed("a text is not UTF-8") from None

    def stamp(self) -> int:
        """Return a time in ns."""
        seconds, nanoseconds = self.take("i"), self.take("I")
        if nanoseconds >= 10**9:
            raise Malformed("a stamp has more than a second of nanoseconds")
        return int(seconds) * 10**9 + int(nanoseconds)

    def end(self) -> None:
        """Refuse bytes that are left over."""
        if len(self._body) - self._place > LONGEST_PADDING:
            raise Malformed("too long")


class Writer:
    """Puts one field after the other."""

    def __init__(self) -> None:
        self._body = bytearray()

    def put(self, kind: str, *values: float) -> None:
        """Add numbers of a kind of the module struct; none of them leaves no gap."""
        if not values:
            return
        size = struct.calcsize(kind)
        self._body += bytes(-len(self._body) % size) + struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        """Add a text."""
        raw = text.encode() + b"\0"
        self.put("I", len(raw))
        self._body += raw

    def header(self, stamp: int, frame: str = "") -> None:
        """Add a header with a stamp in ns."""
        seconds, nanoseconds = divmod(stamp, 10**9)
        self.put("i", seconds)
        self.put("I", nanoseconds)
        self.text(frame)

    def payload(self) -> bytes:
        """Return all bytes."""
        return ENCAPSULATION + bytes(self._body)


KINDS = {
    **{"bool": "?", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"},
    **{"int32": "i", "uint32": "I", "float32": "f", "float64": "d"},
}
"""Kinds of the module struct by type of ROS."""


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """ackermann_msgs/AckermannDriveStamped."""

    stamp: int  # ns
    frame: str
    steering: float  # rad
    steering_rate: float  # rad/s
    speed: float  # m/s
    acceleration: float  # m/s^2
    jerk: float  # m/s^3


@dataclass(frozen=True, slots=True)
class Arm:
    """coopenv_msgs/Arm."""

    stamp: int  # ns
    frame: str
    session: str
    nonce: str
    armed: bool


@dataclass(frozen=True, slots=True)
class GateStatus:
    """coopenv_msgs/GateStatus."""

    stamp: int  # ns
    session: str
    nonce: str
    state: str
    accepted: int
    last_sequence: int
    rejections: Mapping[str, int]  # how often, by reason


def read_command(payload: bytes) -> DriveCommand:
    """Return a command; may hold numbers that are not finite. Raises Malformed: the bytes are none."""
    reader = Reader(payload)
    stamp, frame = reader.stamp(), reader.text()
    command = DriveCommand(stamp, frame, *(reader.take("f") for _ in range(5)))
    reader.end()
    return command


def read_arm(payload: bytes) -> Arm:
    """Return a message that arms or disarms. Raises Malformed: the bytes are none."""
    reader = Reader(payload)
    stamp = reader.stamp()
    arm = Arm(stamp, reader.text(), reader.text(), reader.text(), reader.take("?"))
    reader.end()
    return arm


def read_bool(payload: bytes) -> bool:
    """Return a std_msgs/Bool. Raises Malformed: the bytes are none."""
    reader = Reader(payload)
    value = bool(reader.take("?"))
    reader.end()
    return value


def write_bool(value: bool) -> bytes:
    """Return a std_msgs/Bool."""
    writer = Writer()
    writer.put("?", value)
    return writer.payload()


def write_drive(stamp: int, message: CommandMessage, drive: Drive) -> bytes:
    """Return the message from the gate to the car for a finite command, with a stamp in ns."""
    writer = Writer()
    writer.header(stamp)
    for (kind, _), value in zip(message.neutral.values(), message.values(drive).values(), strict=True):
        writer.put(KINDS[kind], value if kind.startswith("float") else int(value))
    return writer.payload()


def read_drive(payload: bytes, message: CommandMessage) -> Drive:
    """Return the command in a message from a gate to its car. Raises Malformed: the bytes are none."""
    reader = Reader(payload)
    reader.stamp(), reader.text()
    values = {name: reader.take(KINDS[kind]) for name, (kind, _) in message.neutral.items()}
    reader.end()
    return message.drive(values)


def write_status(status: GateStatus) -> bytes:
    """Return the bytes of a gate's status."""
    writer = Writer()
    writer.header(status.stamp)
    for text in (status.session, status.nonce, status.state):
        writer.text(text)
    writer.put("Q", status.accepted, status.last_sequence)
    writer.put("I", len(status.rejections))
    for reason in status.rejections:
        writer.text(reason)
    writer.put("I", len(status.rejections))
    writer.put("Q", *status.rejections.values())
    return writer.payload()
