"""The gate's few messages as CDR, without a library; `coopenv.svea.codec` has all messages of cars."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass

from coopenv.svea.actuation import Manual
from coopenv.svea.gate.cdr import Reader, Writer

MANUAL_KINDS = "ffffHHBffffffff"  # of the fields of ManualControl


@dataclass(frozen=True, slots=True)
class Command:
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
class Status:
    """coopenv_msgs/GateStatus."""

    stamp: int  # ns
    session: str
    nonce: str
    state: str
    accepted: int
    last_sequence: int
    rejections: Mapping[str, int]  # how often, by reason


def read_command(payload: bytes) -> Command:
    """Return a command; may hold numbers that are not finite. Raises Malformed: the bytes are none."""
    reader = Reader(payload)
    stamp, frame = reader.stamp(), reader.text()
    command = Command(stamp, frame, *(reader.take("f") for _ in range(5)))
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


def write_manual(stamp: int, fields: Manual) -> bytes:
    """Return a mavros_msgs/ManualControl with a stamp in ns."""
    writer = Writer()
    writer.header(stamp)
    for kind, value in zip(MANUAL_KINDS, astuple(fields), strict=True):
        writer.put(kind, value)
    return writer.payload()


def write_status(status: Status) -> bytes:
    """Return the bytes of what the gate says of itself."""
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
