"""Reports that vehicles broadcast, and their propagation.

A report holds a pose, its covariance, and the sender's dead reckoning. With the dead reckoning a receiver propagates
the sender's last report to the new one as the sender itself did, P- = F P F^T + Q, whatever messages were lost. The
increment from there to the new report is fused, see correlated_fusion.py.
Source: the information decorrelation of tracklets, Drummond, Tracklets and a hybrid fusion with process noise, SPIE
3163, 1997; the channel filter of Grime and Durrant-Whyte, Data fusion in decentralized sensor networks, Control
Engineering Practice 2(5), 1994.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import sheared, skew
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.belief import propagate
from coopenv.observers.robust.memory import Pose, SenderReport, mat66f, vec3d
from coopenv.world.v2x import as_broadcast, claimed_std, odometry_as_broadcast
from coopenv.world.warp_internals import device_function


@wp.func
def bit_of(vehicle: int) -> wp.uint64:
    """Return a vehicle as a bit; numbers from 64 on share bits with lower ones."""
    return wp.uint64(1) << wp.uint64(vehicle % constants.MASK_BITS)


@wp.func
def includes(mask: wp.uint64, vehicle: int) -> bool:
    """Return whether a mask has a vehicle's bit."""
    return (mask & bit_of(vehicle)) != wp.uint64(0)


@wp.func
def marker_jacobian(marker: Any):
    """Return the derivative of the left error at a point of the body by that at its origin, 6x6."""
    one = wp.identity(3, wp.float64)
    return algebra.lower_blocks(one, -skew(marker), one)


@device_function
def own_report(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Return the report that a vehicle broadcasts: empty while its pose is not known.

    It holds pose, covariance and odometry at the marker, with the changes of a `lie` fault, see `[faults.lie]`.
    """
    report = SenderReport()
    report.tick = tick
    P = memory.P[world, i, 0, 0] + memory.fault_mixture[world, i]
    if memory.search[world, i].active == 0 and algebra.is_known(P):
        marker = vec3d(model.scene.marker[model.landmarks + i])
        if wp.length_sq(marker) > wp.float64(0.0):
            P = sheared(P, -skew(marker))
        claimed = wp.float64(claimed_std(model, state, world, i, tick))
        if claimed > wp.float64(0.0):
            P = claimed * claimed * wp.identity(6, wp.float64)
        pose = memory.member[world, i, 0].pose
        R, p = as_broadcast(model, state, world, i, pose.R, pose.p + pose.R * marker)
        odometry = memory.belief[world, i].odometry
        place = odometry.p + odometry.R * marker
        odometry_R, odometry_p = odometry_as_broadcast(model, state, world, i, pose.R, odometry.R, place)
        report.valid = 1
        report.pose = Pose(R, p)
        report.P = mat66f(P)
        report.odometry = Pose(odometry_R, odometry_p)
        report.depends_on = memory.belief[world, i].depends_on
    return report


@device_function
def propagate_member(model: Any, memory: Any, world: int, i: int, n: int, step: Pose, dt: Any, noise: Any):
    """Propagate a member to its new report by its odometry over dt, and average its twist."""
    averaged = wp.max(algebra.averaging_time(model, i), wp.float64(0.5) * dt)
    lag = wp.float64(constants.MAX_ACCELERATION) * averaged
    q = algebra.odometry_noise(model, i, wp.float64(1.0))[1]
    memory.member[world, i, n].velocity_variance = lag * lag + wp.float64(0.5) * q / averaged
    propagate(memory, world, i, n, step, noise)
    v = step.p / dt
    w = algebra.log_so3(step.R) / dt
    if memory.member[world, i, n].has_twist == 1:
        share = wp.min(wp.float64(1.0), dt / averaged)
        v = memory.member[world, i, n].v + share * (v - memory.member[world, i, n].v)
        w = memory.member[world, i, n].w + share * (w - memory.member[world, i, n].w)
    memory.member[world, i, n].v = v
    memory.member[world, i, n].w = w
    memory.member[world, i, n].has_twist = 1


@device_function
def depends_on_own(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n's report may contain this vehicle's own information."""
    return includes(memory.member[world, i, n].report.depends_on, i)


@device_function
def dependents(memory: Any, world: int, i: int) -> int:
    """Return how many members' reports may contain this vehicle's own information."""
    count = int(0)
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if depends_on_own(memory, world, i, n):
            count += 1
    return count


@device_function
def is_circular(memory: Any, world: int, i: int, n: int) -> bool:
    """Return whether member n may return this vehicle's own information, and has no much smaller variance.

    It may if it depends on this vehicle, or if this vehicle depends on it with an unknown correlation. In a circle of
    vehicles the one with the smallest variance then does not follow the one before it. The remaining dependences have
    an order, as Assumption 1 of the paper requires.
    """
    shares = depends_on_own(memory, world, i, n) or memory.member[world, i, n].correlation_unknown == 1
    if not shares:
        return False
    own = algebra.position_variance(memory.P[world, i, 0, 0])
    return algebra.position_variance(memory.member[world, i, n].report.P) > wp.float64(constants.RETURNING_SHARE) * own
