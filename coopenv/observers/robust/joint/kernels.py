"""The observer with joint messages as the world is handed it, and as a plug-in."""

from typing import Any

from coopenv.estimation.coordinates import Coordinates
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.robust.joint.fusion import fuse_joint_messages
from coopenv.observers.robust.joint.memory import JOINT_SIZES, JointMemory, joint_rules
from coopenv.observers.robust.joint.messages import JOINT_MESSAGES
from coopenv.observers.robust.joint.radio import clear_joint_messages, receive_joint, send_joint
from coopenv.observers.robust.kernels import OPTIONS, in_space
from coopenv.observers.robust.observer import make_estimate, make_start
from coopenv.world.device_function import device_function
from coopenv.world.embedded import Embedded


@device_function
def accept(model: Any, state: Any, memory: Any, world: int, i: int, now: Any):
    """Accept the belief: its members are estimated along with the vehicle itself, and none is held to what it says."""


ROBUST_JOINT = Embedded(
    "robust_joint",
    make_estimate(receive_joint, fuse_joint_messages, accept),
    make_start(clear_joint_messages, receive_joint),
    send_joint,
    JointMemory,
    JOINT_SIZES,
    valid=joint_rules(),
    messages=JOINT_MESSAGES,
    coordinates=Coordinates.LEFT,
    options=OPTIONS,
)


def robust_joint(setup: Setup) -> Observer:
    """The robust observer with larger, joint messages, for vehicles in space.

    Raises:
        CoopenvError: the vehicle moves on a plane and its odometry is its commands.
    """
    return in_space("robust_joint", ROBUST_JOINT, setup)
