"""What the topics of a car are called in the authors' ROS 1 stack, and how their messages are translated."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from coopenv.svea.actuation import from_manual, to_lowlevel
from coopenv.svea.codec import decode, decode_ros1, encode, encode_ros1, ros1
from coopenv.svea.deployment import Car, DeploymentError
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.translation import point_of, to_ros1, to_ros2
from coopenv.svea.warm_up import empty


def low_level(message: Any) -> Any:
    """Return a ManualControl as the lli_ctrl that does the same, steering to the left positive on both."""
    wanted = to_lowlevel(from_manual(message.y, message.z, message.aux3))
    numbers = (wanted.steering, wanted.velocity, wanted.trans_diff, wanted.ctrl)
    return ros1().types["svea_msgs/msg/lli_ctrl"](*numbers)


@dataclass(frozen=True)
class Counterpart:
    """A topic of the authors' that tells what one of ours does."""

    name: str  # with {agent}, the agent's number, or {car}, the car's name
    type: str  # of ROS 1
    convert: Callable[[Any], Any] = to_ros1  # from our message to theirs
    exact: bool = True  # nothing is lost, and the way back is `to_ros2`; else it is only for them


COUNTERPARTS = {
    Role.DETECTIONS: Counterpart("agent{agent}/pixy_node/objectsInfo", TOPICS[Role.DETECTIONS].type),
    Role.BEARINGS: Counterpart("agent{agent}/pixy_landmark_detection/objectsBearing", TOPICS[Role.BEARINGS].type),
    Role.CAMERA_INFO: Counterpart("agent{agent}/pixy_node/camera_info", TOPICS[Role.CAMERA_INFO].type),
    Role.WHEEL: Counterpart("agent{agent}/actuation_twist", TOPICS[Role.WHEEL].type),
    Role.TRUTH: Counterpart("qualisys/{car}/odom", TOPICS[Role.TRUTH].type),
    Role.POINT: Counterpart("agent{agent}/riccatiPoint", TOPICS[Role.POINT].type),
    Role.ESTIMATE: Counterpart("agent{agent}/riccatiPoint", TOPICS[Role.POINT].type, point_of, exact=False),
    Role.MANUAL: Counterpart("agent{agent}/lli/ctrl_request", "svea_msgs/msg/lli_ctrl", low_level, exact=False),
}
"""By role. Commands are not among them: they go to the gate, and what the gate has let through to the low level."""


@dataclass(frozen=True)
class Route:
    """A topic of one car and its counterpart."""

    topic: str
    ours: str  # ROS 2 type
    name: str
    theirs: Counterpart

    def out(self, payload: bytes) -> bytes:
        """Return ROS 1 bytes for CDR bytes. Raises CoopenvError: they are no such message."""
        return encode_ros1(self.theirs.convert(decode(payload, self.ours)))

    def back(self, payload: bytes) -> bytes:
        """Return CDR bytes for ROS 1 bytes, likewise."""
        return encode(to_ros2(decode_ros1(payload, self.theirs.type)))

    def warm_up(self) -> None:
        """Translate once, since the first time compiles and takes a tenth of a second."""
        translated = self.out(encode(empty(self.ours)))
        if self.theirs.exact:
            self.back(translated)


def routes_of(car: Car) -> tuple[Route, ...]:
    """Return those of a car. Raises DeploymentError: it has no number."""
    agent = car.agent_number
    if agent is None:
        raise DeploymentError(f"cars: {car.name}: agent is missing: the N of agentN in the authors' names (or marker)")
    return tuple(
        Route(topic_of(car.name, role), TOPICS[role].type, other.name.format(agent=agent, car=car.name), other)
        for role, other in COUNTERPARTS.items()
    )
