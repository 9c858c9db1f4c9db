"""ROS 1: the authors' names and types on the wire, and the topics of a ROS 1 master as a transport.

What has a counterpart among the names of the profile for all users goes out under the authors' name as a ROS 1 message,
over any transport. If that loses something (an estimate becomes a position alone) or there is none, it goes out under
our own name as well, as CDR, for other ends of coopenv.

A master is reached by rospy, for cars with ROS noetic; payloads are ROS 1 bytes.
"""

import atexit
import math
import os
import socket
import struct
import threading
import time
import xmlrpc.client
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from http.client import HTTPConnection
from typing import Any, Unpack

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import needing
from coopenv.cars.gate.wheel_command import CommandMessage, MotionCommand, read_drive
from coopenv.cars.link.transport import (
    Address,
    Arrival,
    Callback,
    HeartbeatTransport,
    LinkError,
    Transport,
    address_of,
    matcher,
    trouble_at,
)
from coopenv.cars.messages.codec import cdr_of, decode, encode, make, ros1, ros1_of
from coopenv.cars.settings.deployment import Car, DeploymentError
from coopenv.cars.settings.profile import AUTHORS, SVEA, CarProfile, Role, Way

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
        """True if the conversion loses nothing and is therefore invertible."""
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
    """Return the routes of a car. Raises DeploymentError: it has no number."""
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
        """Take a network with the authors' messages, which is closed with this, and the translated topics."""
        self._wire, self.clock = wire, wire.clock
        self.announce, self.watch, self.close = wire.announce, wire.watch, wire.close
        self._routes = {route.topic: route for route in routes}
        self._names = {route.name for route in self._routes.values()}
        for route in {(route.ours, route.theirs): route for route in self._routes.values()}.values():
            translated = route.out(encode(make(route.ours)))  # the first time compiles and takes a tenth of a second
            if route.exact:
                cdr_of(translated, route.theirs)

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`."""
        route = self._routes.get(topic)
        if route is None or not route.exact:
            self._wire.publish(topic, payload, attachment, **way)
        if route is not None:
            with suppress(CoopenvError):  # no message of its topic's type, which goes no further
                beside = attachment if route.exact else b""
                self._wire.publish(route.name, route.out(payload), beside, **way)

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
    """Pass on messages of an authors' topic; bytes of another type are dropped."""
    try:
        payload = cdr_of(arrival.payload, route.theirs)
    except CoopenvError:
        return
    callback(Arrival(route.topic, payload, arrival.received, arrival.attachment))


ENVELOPE = "std_msgs/msg/UInt8MultiArray"
"""Type of topics that the authors do not have: CDR bytes after their attachment."""

CALLER = "/coopenv"

_lock = threading.Lock()
_master: str | None = None


def rospy() -> Any:
    """Return the library. Raises CoopenvError: it is not installed for this interpreter."""
    with needing(
        "ROS 1 needs rospy: install Debian's python3-rospy and python3-rosmaster, or ROS noetic, and use the "
        "system's interpreter (/usr/bin/python3 -m venv --system-site-packages VENV)"
    ):
        import rospy
    return rospy


class Master:
    """The ROS master, asked with a time limit, which rospy's own proxy has not."""

    def __init__(self, address: Address, timeout: float) -> None:
        self.uri = f"http://{address.authority}"
        self._proxy = xmlrpc.client.ServerProxy(self.uri, transport=_Timed(timeout))
        self._lock = threading.Lock()

    def ask(self, question: str, *arguments: str) -> Any:
        """Return an answer; None: there is no such thing. Raises OSError: the master does not answer."""
        with self._lock:
            try:
                code, _, value = getattr(self._proxy, question)(CALLER, *arguments)
            except (xmlrpc.client.Error, ValueError, TypeError) as error:
                raise OSError(f"no ROS master ({type(error).__name__})") from None
        return value if code == 1 else None


class _Timed(xmlrpc.client.Transport):
    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)  # which is closed when a question fails
        connection.timeout = self._timeout
        return connection


def join(address: Address, timeout: float) -> Master:
    """Make this process a node of a master, once.

    Raises:
        LinkError: no master answers, or the process is a node of another one already.
        CoopenvError: rospy is not installed.
    """
    global _master
    library, master = rospy(), Master(address, timeout)
    try:
        master.ask("getPid")
    except OSError as error:
        reason = trouble_at(address, None, timeout) or error
        raise LinkError(f"{address.protocol}/{address.authority}: no ROS master there ({reason})") from None
    with _lock:
        if _master not in (None, master.uri):
            raise LinkError(f"{master.uri}: this process is a node of {_master} already, and can be one of one only")
        if _master is None:
            os.environ["ROS_MASTER_URI"] = master.uri
            if not {"ROS_IP", "ROS_HOSTNAME"} & set(os.environ):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:  # else rospy chooses any address
                    probe.connect((address.host, address.port))  # nothing is sent
                    os.environ["ROS_IP"] = str(probe.getsockname()[0])  # of this computer as the master sees it
            options = {"disable_signals": True, "disable_rostime": True, "disable_rosout": True}
            library.init_node("coopenv", argv=[], anonymous=True, **options)
            atexit.register(library.signal_shutdown, "the process ends")
            _master = master.uri
    return master


@cache
def raw_type(kind: str) -> Any:
    """Return a message class of a ROS 1 type whose content is bytes; peers check its type as ever."""
    text, checksum = ros1().generate_msgdef(kind)
    named = {"_type": kind.replace("/msg/", "/"), "_md5sum": checksum, "_full_text": text, "__slots__": ["_buff"]}
    return type("Raw", (rospy().AnyMsg,), named)


def sealed(payload: bytes, attachment: bytes) -> bytes:
    """Return both as a UInt8MultiArray without dimensions."""
    content = struct.pack("<I", len(attachment)) + attachment + payload
    return struct.pack("<III", 0, 0, len(content)) + content


def opened(message: bytes) -> tuple[bytes, bytes] | None:
    """Return payload and attachment of `sealed`; None: it is not one."""
    if len(message) < 16:
        return None
    dimensions, offset, size, beside = struct.unpack_from("<4I", message)
    if dimensions or offset or size != len(message) - 12 or beside > size - 4:
        return None
    return message[16 + beside :], message[16 : 16 + beside]


PRESENCE = "coopenv/presence"
MOST_WAITING = 256  # messages per topic and peer; then the oldest are lost
PATIENCE = 0.5  # s that the first reliable message of a topic waits for a subscriber
CHECKS = 4  # of the presence's beats until the master is looked at again


class Ros1(HeartbeatTransport):
    """The node of this process as a transport.

    What is beside a message (its signature) travels only where the topic's type is our own: types of ROS 1 have no
    place for it.
    """

    def __init__(self, master: Master, types: Mapping[str, str]) -> None:
        """Take a master, and the ROS 1 types of topics that have one."""
        super().__init__()
        self._master, self._types, self._rospy = master, dict(types), rospy()
        self._lock = threading.RLock()
        self._publishers: dict[str, Any] = {}
        self._wanted: list[tuple[str, Callback]] = []
        self._subscribers: dict[tuple[int, str], Any] = {}  # by place in `_wanted` and topic
        self._beats = 0
        threading.Thread(target=self._beat_on, name="ros1", daemon=True).start()

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`."""
        if self._closed.is_set():
            return
        with suppress(Exception):  # whatever keeps it from being sent, it is lost
            message = self._kind(topic)()
            message._buff = payload if topic in self._types else sealed(payload, attachment)
            self._publisher(topic, way.get("reliable", False)).publish(message)

    def _kind(self, topic: str) -> Any:
        return raw_type(self._types.get(topic, ENVELOPE))

    def _publisher(self, topic: str, patient: bool) -> Any:
        with self._lock:
            found = self._publishers.get(topic)
            if found is not None:
                return found
            made = self._rospy.Publisher(f"/{topic}", self._kind(topic), queue_size=MOST_WAITING)
            self._publishers[topic] = made
        self.clock.wait(made.get_num_connections, PATIENCE if patient else 0.0)
        return made

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`; topics of a pattern are found as they appear, a moment later."""
        with self._lock:
            self._wanted.append((pattern, callback))
        self._discover()

    def _subscribe(self, topic: str, callback: Callback) -> Any:
        typed = topic in self._types

        def arrive(message: Any) -> None:
            content = (message._buff, b"") if typed else opened(message._buff)
            if content is not None and not self._closed.is_set():
                callback(Arrival(topic, content[0], time.time_ns(), content[1]))

        options = {"queue_size": MOST_WAITING, "tcp_nodelay": True}
        return self._rospy.Subscriber(f"/{topic}", self._kind(topic), arrive, **options)

    def _discover(self) -> None:
        """Subscribe to topics by name, and to topics of a pattern with the expected type."""
        published: list[str] = []
        if any("*" in pattern for pattern, _ in self._wanted):
            with suppress(OSError):  # the master is away: those who know each other go on
                names = [
                    (name.removeprefix("/"), kind) for name, kind in self._master.ask("getPublishedTopics", "") or ()
                ]
                published = [name for name, kind in names if kind == self._kind(name)._type and name != PRESENCE]
        with self._lock:
            for place, (pattern, callback) in enumerate(self._wanted):
                for topic in filter(matcher(pattern), published) if "*" in pattern else (pattern,):
                    if (place, topic) not in self._subscribers and not self._closed.is_set():
                        self._subscribers[place, topic] = self._subscribe(topic, callback)

    def _send_heartbeat(self, name: str, payload: bytes) -> None:
        self.publish(PRESENCE, payload, name.encode())

    def _receive_heartbeats(self) -> None:
        self.subscribe(PRESENCE, lambda a: self.heartbeat(a.attachment.decode(errors="replace"), a.payload))

    def beat(self) -> None:
        """Look after the registration, too: a master that has been started anew knows nothing of this node."""
        super().beat()
        self._beats += 1
        with suppress(OSError):
            if self._beats % CHECKS == 0 and self._master.ask("lookupNode", self._rospy.get_name()) is None:
                self._unregister()
        self._discover()

    def _unregister(self) -> None:
        with self._lock:
            for thing in (*self._publishers.values(), *self._subscribers.values()):
                with suppress(Exception):  # not known to the master
                    thing.unregister()
            self._publishers.clear()
            self._subscribers.clear()

    def _end(self) -> None:
        """Withdraw this transport's publications and subscriptions; the node itself ends with the process."""
        time.sleep(0.05)  # rospy sends in threads of its own
        self._closed.set()
        self._unregister()


def open_ros1(endpoint: str, types: Mapping[str, str], timeout: float = 2.0) -> Ros1:
    """Become a node of a ROS master.

    Args:
        endpoint: of the master, e.g. "tcp/127.0.0.1:11311".
        types: ROS 1 type by topic, without its leading slash; what is not in it is only for other coopenv ends.
        timeout: s to wait for the master.

    Raises:
        CoopenvError: rospy is not installed, or the endpoint is not one.
        LinkError: no master answers.
    """
    return Ros1(join(address_of(endpoint), timeout), types)
