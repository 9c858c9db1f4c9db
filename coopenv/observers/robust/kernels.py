"""The observer as the world is handed it, and as a plug-in."""

from coopenv.base.errors import CoopenvError
from coopenv.estimation.coordinates import Coordinates
from coopenv.observers.contract import Observer, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.observer import make_estimate, make_start
from coopenv.observers.robust.told.correlations import receive_told, send_told
from coopenv.observers.robust.told.fusion import hear_all
from coopenv.observers.robust.told.memory import TOLD_SIZES, ToldMemory, told_rules
from coopenv.observers.robust.told.messages import TOLD_MESSAGES
from coopenv.observers.robust.told.separation import begin_told, separate
from coopenv.world.embedded import Embedded

OPTIONS = {"max_unroll": 1, "inline_threshold": 1000, "optimization_level": 3}
"""Of the Warp module; without the first two there is long straight code, which takes long to compile and is no faster;
with the last one, which is Warp's on a GPU, steps take a twentieth less than with Warp's 2."""

ROBUST = Embedded(
    "robust",
    make_estimate(receive_told, hear_all, separate),
    make_start(begin_told, receive_told),
    send_told,
    ToldMemory,
    TOLD_SIZES,
    valid=told_rules(),
    messages=TOLD_MESSAGES,
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
