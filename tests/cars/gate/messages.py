"""The gate's messages as the station makes them, by the general codec."""

from __future__ import annotations

from coopenv.cars.messages.codec import encode, header, make
from coopenv.cars.settings.profile import SVEA, Role


def command(stamp: int, session: str, sequence: int, steering: float = 0.1, speed: float = 0.2) -> bytes:
    return framed_command(stamp, f"{session}:{sequence}", (steering, 0.0, speed, 0.0, 0.0))


def framed_command(stamp: int, frame: str, fields: tuple[float, float, float, float, float]) -> bytes:
    names = ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
    drive = make("ackermann_msgs/msg/AckermannDrive", **dict(zip(names, fields, strict=True)))
    return encode(make(SVEA.topics[Role.COMMAND].type, header=header(stamp, frame), drive=drive))


def arm(stamp: int, session: str, nonce: str, armed: bool = True) -> bytes:
    fields = {"session": session, "nonce": nonce, "armed": armed}
    return encode(make(SVEA.topics[Role.ARM].type, header=header(stamp), **fields))


def stop(value: bool = True) -> bytes:
    return encode(make(SVEA.topics[Role.STOP].type, data=value))
