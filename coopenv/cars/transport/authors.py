"""The authors' names and types on the wire, those of the profile for all users.

What has a counterpart goes out under the authors' name as a ROS 1 message. If that loses something (an estimate becomes
a position alone) or there is none, it goes out under our own name as well, as CDR, for other ends of coopenv.
"""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.cars.codec import cdr_of, decode, encode, make, ros1, ros1_of
from coopenv.cars.deployment import Car, DeploymentError
from coopenv.cars.gate.core import read_drive
from coopenv.cars.profile import AUTHORS, SVEA, CarProfile, CommandMessage, MotionCommand, Role
from coopenv.cars.transport.base import Arrival, Callback, Transport, matcher

PER_PERCENT = 1.27  # of the whole numbers of lli_ctrl
DEAD_BAND = 15.0  # % of the speed controller's range about zero in which the wheels do not turn
LOW_GEAR = 0b111000  # bits 0-2: high gear, front and rear differential locked; 3-5: which of them to change


def low_level(drive: MotionCommand, command: CommandMessage) -> Any:
    """Return the lli_ctrl (Teensy) of a finite command, with the dead band of the speed controller leapt over.

    Steering to the left is positive. Speeds are cut to whole per cent, as the car's own interface does.
    """
    steering = 100.0 * command.share(command.steering, drive.steering)
    speed: float = math.trunc(100.0 * command.share(command.speed, drive.speed))
    if speed:
        speed = speed * (100.0 - DEAD_BAND) / 100.0 + math.copysign(DEAD_BAND, speed)
    kind = ros1().types["svea_msgs/msg/lli_ctrl"]
    return kind(round(PER_PERCENT * steering), round(PER_PERCENT * speed), LOW_GEAR, 0)


NAMES = {
    **{role: names[-1] for role, names in AUTHORS.items()},
    Role.ESTIMATE: AUTHORS[Role.POINT][-1],
    Role.MANUAL: "{agent}/lli/ctrl_request",
}
"""The authors' topics with the content of ours, by `agentN` and the car's name.

Commands are not among them: they go to the gate, and what the gate has let through to the low level."""
LOSSY = {Role.ESTIMATE: SVEA.topics[Role.POINT].type, Role.MANUAL: "svea_msgs/msg/lli_ctrl"}
"""ROS 1 types of those that lose something, and are only for the authors; the others' types are SVEA's."""


@dataclass(frozen=True)
class TopicRoute:
    """A topic of one car and the authors' topic with its content."""

    role: Role
    topic: str
    ours: str  # ROS 2 type
    name: str
    theirs: str  # ROS 1 type
    command: CommandMessage  # of the topic `manual`

    @property
    def exact(self) -> bool:
        """Whether nothing is lost, so that there is a way back."""
        return self.role not in LOSSY

    def out(self, payload: bytes) -> bytes:
        """Return ROS 1 bytes for CDR bytes. Raises CoopenvError: they are no such message."""
        if self.role is Role.MANUAL:
            return bytes(ros1().serialize_ros1(low_level(read_drive(payload, self.command), self.command), self.theirs))
        if self.role is Role.ESTIMATE:
            message = decode(payload, self.ours)
            payload = encode(make(self.theirs, header=message.header, point=message.pose.pose.position))
        return ros1_of(payload, self.theirs)


def routes_of(car: Car, profile: CarProfile = SVEA) -> tuple[TopicRoute, ...]:
    """Return those of a car. Raises DeploymentError: it has no number."""
    agent = car.agent_number
    if agent is None:
        raise DeploymentError(f"cars: {car.name}: agent is missing: the N of agentN in the authors' names (or marker)")
    names = {"agent": f"agent{agent}", "body": car.name}
    return tuple(
        TopicRoute(
            *(role, profile.topic_of(car.name, role), profile.topics[role].type),
            *(name.format(**names), LOSSY.get(role, SVEA.topics[role].type), profile.command),
        )
        for role, name in NAMES.items()
    )


class Authors:
    """A transport whose topics are translated on their way to and from another one.

    Signatures count for the CDR bytes under our names. They go along with exact counterparts, whose bytes come back as
    they were, and otherwise with the message under our own name.
    """

    def __init__(self, wire: Transport, routes: Iterable[TopicRoute]) -> None:
        """Take a network with the authors' messages, which is closed with this, and what is translated."""
        self._wire = wire
        self.announce, self.watch, self.close = wire.announce, wire.watch, wire.close
        self._routes = {route.topic: route for route in routes}
        self._names = {route.name for route in self._routes.values()}
        for route in {(route.ours, route.theirs): route for route in self._routes.values()}.values():
            translated = route.out(encode(make(route.ours)))  # the first time compiles and takes a tenth of a second
            if route.exact:
                cdr_of(translated, route.theirs)

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`."""
        route = self._routes.get(topic)
        if route is None or not route.exact:
            self._wire.publish(topic, payload, attachment, urgent=urgent, reliable=reliable)
        if route is not None:
            with suppress(CoopenvError):  # no message of its topic's type, which goes no further
                beside = attachment if route.exact else b""
                self._wire.publish(route.name, route.out(payload), beside, urgent=urgent, reliable=reliable)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        matches = matcher(pattern)
        for route in self._routes.values():
            if route.exact and matches(route.topic):
                self._wire.subscribe(route.name, partial(_translate, route, callback))
        if pattern in self._routes and self._routes[pattern].exact:
            return

        def pass_on(arrival: Arrival) -> None:
            if arrival.topic not in self._names:
                callback(arrival)

        self._wire.subscribe(pattern, pass_on)


def _translate(route: TopicRoute, callback: Callback, arrival: Arrival) -> None:
    """Pass on what came under an authors' name; bytes of another type go no further."""
    try:
        payload = cdr_of(arrival.payload, route.theirs)
    except CoopenvError:
        return
    callback(Arrival(route.topic, payload, arrival.received, arrival.attachment))
