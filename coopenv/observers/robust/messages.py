"""Reports that vehicles broadcast, their propagation, and their messages: 172 bytes, with correlations 256.

A report holds a pose, its covariance, and the sender's dead reckoning. With the dead reckoning a receiver propagates
the sender's last report to the new one as the sender itself did, P- = F P F^T + Q, also if messages were lost. The
increment from there to the new report is fused, see correlated_fusion.py.
Source: the information decorrelation of tracklets, Drummond, Tracklets and a hybrid fusion with process noise, SPIE
3163, 1997; the channel filter of Grime and Durrant-Whyte, Data fusion in decentralized sensor networks, Control
Engineering Practice 2(5), 1994.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.base.sections import LARGEST
from coopenv.estimation.linalg import sheared, skew
from coopenv.estimation.poses import Array, exp_so3, log_so3
from coopenv.observers.contract import Estimate, Message, check_estimate, is_definite
from coopenv.observers.robust import algebra, constants
from coopenv.observers.robust.algebra import Pose, mat66f, vec3d
from coopenv.observers.robust.constants import MAX_CORRELATIONS, MIN_VARIANCE, STEPS
from coopenv.observers.robust.joint_state import propagate
from coopenv.observers.robust.memory import SenderReport
from coopenv.observers.robust.sources import guarded_covariance
from coopenv.world.embedded import Messages
from coopenv.world.v2x import as_broadcast, claimed_std, odometry_as_broadcast
from coopenv.world.warp_internals import device_function, subroutine


@wp.func
def bit_of(vehicle: int) -> wp.uint64:
    """Return a vehicle as a bit; numbers from 64 on share bits with lower ones."""
    return wp.uint64(1) << wp.uint64(vehicle % constants.MASK_BITS)


@wp.func
def includes(mask: wp.uint64, vehicle: int) -> bool:
    """Return whether a mask has a vehicle's bit."""
    return (mask & bit_of(vehicle)) != wp.uint64(0)


@subroutine
def own_report(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Return the report that a vehicle broadcasts: empty while its pose is not known.

    It holds pose, covariance and odometry at the marker, with the changes of a `lie` fault, see `[faults.lie]`.
    """
    report = SenderReport()
    report.tick = tick
    P = guarded_covariance(memory, world, i)
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
    theirs = algebra.position_variance(memory.member[world, i, n].report.P)
    return wp.float64(constants.DISTINCT_VARIANCES) * theirs > own


def write(observer: Any) -> Message:
    """Return pose, covariance, dead reckoning (single precision) and a mask; at times correlations in whole steps, too.

    While the pose is not known, the message is empty.
    """
    report = observer.memory.outbox[0]
    if not report["valid"]:
        return Message()
    extra = {"odometry": six_of(report["odometry"]).astype(np.float32), "depends_on": np.array([report["depends_on"]])}
    if report["carries_correlations"]:
        broadcast = observer.memory.outbox_correlation[0]
        broadcast = broadcast[broadcast["vehicle"] >= 0]
        ages = (int(report["tick"]) - broadcast["tick"]) * observer.unit
        extra |= {
            "correlated_vehicles": broadcast["vehicle"].astype(np.uint16),
            "ages": ages.astype(np.float32),
            "correlations": broadcast["matrix"].astype(np.int8),
        }
    return Message(report["pose"]["p"].copy(), report["pose"]["R"].copy(), report["P"].copy(), extra)


def six_of(pose: Any) -> Array:
    """Return a pose as rotation vector and position (6,)."""
    return np.concatenate([log_so3(pose["R"]), pose["p"]])


def from_six(values: Array) -> tuple[Array, Array]:
    """Return the rotation and position of a pose (6,)."""
    return exp_so3(values[:3]), values[3:]


def read(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Put a message into the inbox; a CoopenvError or LookupError means that it is malformed."""
    report = observer.memory.inbox[sender]
    report["tick"], report["valid"], report["carries_correlations"] = sent, 0, 0
    if message.position is None and not message.extra:  # the sender is searching for its pose
        return
    if message.position is None or message.rotation is None or message.covariance is None:
        raise CoopenvError("message: no pose with a covariance")
    P = np.asarray(message.covariance, np.float64)
    check_estimate(Estimate(message.rotation, message.position, P))
    if not is_definite(P, MIN_VARIANCE, LARGEST**2):
        raise CoopenvError("message: covariance is not positive definite, or not plausible")
    odometry, depends_on = np.asarray(message.extra["odometry"], np.float64), np.asarray(message.extra["depends_on"])
    if odometry.shape != (6,) or not (np.abs(odometry) <= LARGEST).all():
        raise CoopenvError("message: odometry")
    if depends_on.shape != (1,) or depends_on.dtype != np.uint64:
        raise CoopenvError("message: depends_on")
    if "correlated_vehicles" in message.extra:
        _read_correlations(observer, sender, message, sent)
        report["carries_correlations"] = 1
    report["pose"], report["P"] = (message.rotation, message.position), message.covariance
    report["odometry"], report["depends_on"], report["valid"] = from_six(odometry), depends_on[0], 1


def lead_along(made: Message, honest: Message) -> Message:
    """Return a false message with odometry that leads to its pose, as the honest odometry leads to the honest pose."""
    if made.position is None or "odometry" not in honest.extra:
        return made
    R, p = from_six(np.asarray(honest.extra["odometry"], np.float64))
    back = R @ np.asarray(honest.rotation).T
    led = np.concatenate([log_so3(back @ made.rotation), p + back @ (made.position - honest.position)])
    return replace(made, extra={**made.extra, "odometry": led.astype(honest.extra["odometry"].dtype)})


def _read_correlations(observer: Any, sender: int, message: Message, sent: int) -> None:
    """Store the correlations of a message; a CoopenvError or LookupError means that they are malformed.

    Their vehicles must differ from each other and from the sender.
    """
    broadcast, ages, matrices = (
        np.asarray(message.extra[name]) for name in ("correlated_vehicles", "ages", "correlations")
    )
    if broadcast.ndim != 1 or broadcast.dtype.kind not in "iu" or len(broadcast) > MAX_CORRELATIONS:
        raise CoopenvError("message: correlated_vehicles")
    vehicles = {sender, *broadcast.tolist()}
    known = range(len(observer.setup.target_names) - observer.setup.landmarks)
    if len(vehicles) <= len(broadcast) or not vehicles <= set(known):
        raise CoopenvError("message: correlated_vehicles")
    if matrices.shape != (len(broadcast), 6, 6) or matrices.dtype != np.int8 or (matrices < -STEPS).any():
        raise CoopenvError("message: correlations")
    if ages.shape != broadcast.shape or not ((ages >= 0.0) & (ages <= LARGEST)).all():
        raise CoopenvError("message: ages")
    kept = observer.memory.correlation[sender]
    kept["vehicle"] = -1
    for n, (vehicle, age, matrix) in enumerate(zip(broadcast.tolist(), ages.tolist(), matrices, strict=True)):
        kept[n] = vehicle, sent - observer.units(age), matrix


ROBUST_MESSAGES = Messages(write, read, lead_along)
