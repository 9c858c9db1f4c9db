"""Noise and choices of the planar filters."""

import math
from dataclasses import dataclass, field
from typing import Literal

from coopenv.observers.planar.commands import Wheels

Nine = tuple[float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise and choices of the filter; one of them serves all robots."""

    turn_noise: tuple[float, float, float] = (0.02, 0.3, 0.0)
    """rad/sqrt(s), plus rad/sqrt(s) per rad/s, plus rad/sqrt(s) per m/s."""
    path_noise: tuple[float, float] = (0.01, 0.3)  # m/sqrt(s), plus m/sqrt(s) per m/s
    slide_noise: float = 0.0  # m/sqrt(s) sideways per m/s
    bearing_std: float = 0.03  # rad
    gate: float = 9.0  # normalised innovation squared above which a bearing is dropped
    others_gate: float = math.inf  # the same of a bearing to or from a robot, before the covariances grow
    soft: float = math.inf  # the same above which a bearing's variance grows with it (a heavy tail)
    second_order: bool = False  # whether a bearing's variance grows with what its linearisation leaves out
    mean: Nine = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Turn scale, speed scale, turn offset, speed offset, slowdown, lead, bearing bias, wheels' share and drift at the
    start."""
    std: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same
    walk: Nine = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # of the same, per sqrt(s)
    drifting: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the drift, rad/s, of robots that drift, and their share; `std` has that of the others."""
    jitter: float = 0.0  # s, by which a step of the commanded rate may take effect sooner or later
    level_std: float = 0.0  # of the logarithm of a factor on all motion noise, learnt from the innovations; 0: fixed
    wheels: Wheels = field(default_factory=Wheels)
    fusion: Literal["plain", "intersection"] = "plain"
    """How a neighbour's covariance counts: `plain` takes its errors as independent of ours, `intersection` does not
    (split covariance intersection with the weight that leaves the least variance)."""
    dependent: float = 1.0  # the share of both covariances that `intersection` takes as possibly shared errors
    arm_m: float = 0.0  # m, how far a rad of heading counts in that variance
    mutual: bool = False  # whether a robot that is seen corrects itself with the sighting, too


TEXTBOOK = Tuning()
IROBOT_CREATE = Wheels(
    delay=(0.0, 0.1, 0.2, 0.4),
    share=(0.33, 0.42, 0.16, 0.09),
    arc=((0.15, 1.8), (0.35, 1.3), (0.8, 0.88), (1.6, 0.84), (2.6, 0.8), (3.2, 0.95), (3.8, 1.1), (4.5, 0.975)),
    spot=1.03,
    slow=0.065,
    slow_gain=0.22,
    centre=0.005,
)
"""The iRobot Create of MR.CLAM, measured on sub-dataset 6; all of its robots agree (docs/data.md)."""
CALIBRATING = Tuning(
    turn_noise=(0.004, 0.1, 0.1),
    path_noise=(0.002, 0.22),
    slide_noise=0.05,
    bearing_std=0.025,
    gate=math.inf,
    others_gate=36.0,
    soft=4.0,
    second_order=True,
    mean=(0.936, 1.0, 0.005, 0.004, 1.0, 0.15, 0.0, 1.0, 0.0),
    std=(0.25, 0.04, 0.001, 0.002, 0.3, 0.05, 0.007, 0.3, 0.001),
    walk=(0.0003, 0.0003, 0.0, 0.0001, 0.0003, 0.0005, 0.0, 0.0, 0.0),
    drifting=(0.02, 0.02),
    jitter=0.09,
    level_std=0.7,
    wheels=IROBOT_CREATE,
    fusion="intersection",
    dependent=0.25,
    arm_m=1.0,
    mutual=True,
)
