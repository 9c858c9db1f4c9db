"""The observer as the world is handed it, and as a plug-in."""

from coopenv.errors import CoopenvError
from coopenv.estimation.coordinates import Coordinates
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.memory import SIZES, RobustMemory, rules_for
from coopenv.observers.robust.messages import MESSAGES
from coopenv.observers.robust.observer import make_estimate, make_start
from coopenv.observers.robust.tracklets import clear_messages, fuse_messages, receive, send
from coopenv.world.embedded import Embedded

OPTIONS = {"max_unroll": 1}  # of the Warp module; without it there is long straight code, which takes long to compile

ROBUST = Embedded(
    "robust",
    make_estimate(receive, fuse_messages),
    make_start(clear_messages, receive),
    send,
    RobustMemory,
    SIZES,
    valid=rules_for(SIZES["K"]),
    messages=MESSAGES,
    coordinates=Coordinates.LEFT,
    options=OPTIONS,
)


def robust(setup: Setup) -> Observer:
    """This project's observer for vehicles in space: several hypotheses, gates.

    Raises:
        CoopenvError: the vehicle moves on a plane and its odometry is its commands.
    """
    return in_space("robust", ROBUST, setup)


def in_space(name: str, observer: Embedded, setup: Setup) -> Observer:
    """Return an observer for a vehicle in space; a CoopenvError names the one for robots on a plane."""
    if setup.planar:
        raise CoopenvError(
            f"observer '{name}' is for vehicles in space; '{setup.name}' is a recorded robot on a plane whose odometry "
            "is its commands: use 'planar_robust'"
        )
    return KernelObserver(observer, setup)
