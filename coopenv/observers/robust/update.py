"""A frame's bearings against the belief: which of them fit, and whether the vehicle is where it believes to be.

After a search the vehicle's pose is taken from one frame alone, whatever was believed of it before. The other members
stay. The vehicle's covariance becomes that of the solution, which inherits the members' errors,
G (N + H_o P_o H_o^T) G^T with G = (H^T W H)^-1 H^T W, and so do its covariances with them, -G H_o P_o.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    between,
    carried,
    inverse6,
    inverse_factor,
    is_regular,
    odometry_noise,
    with_noise,
)
from coopenv.observers.robust.belief import apply_error, own_estimate
from coopenv.observers.robust.correction import iterated_update
from coopenv.observers.robust.evidence import test_words
from coopenv.observers.robust.measurements import innovation_squared
from coopenv.observers.robust.memory import Anchor, Estimate, Frame, mat66d, vec2d, vec6d
from coopenv.observers.robust.odometry import begin_errors, lasting_noise
from coopenv.observers.robust.search import begin_search
from coopenv.observers.robust.trust import forget_evidence, test_missed
from coopenv.world.device_function import device_function


@device_function
def gate(frame: Frame, memory: Any, world: int, i: int):
    """Linearise the lines and mark those that fit; return the share of the others, how many fit, and their NIS.

    Bearings to distrusted senders do not count in the share; it is -1 if none counts.
    """
    counted = int(0)
    missed = int(0)
    fitting = int(0)
    total = wp.float64(0.0)
    for n in range(frame.lines):
        nis = innovation_squared(frame, memory, world, i, n)
        fits = int(0)
        if nis >= wp.float64(0.0) and nis < wp.float64(constants.BEARING_GATE):
            fits = 1
            total += nis
        memory.line[world, n].fits = fits
        fitting += fits
        member = memory.line[world, n].member
        if member == 0 or memory.member[world, i, member].distrusted == 0:
            counted += 1
            missed += 1 - fits
    share = wp.float64(-1.0)
    if counted > 0:
        share = wp.float64(missed) / wp.float64(counted)
    return share, fitting, total


@device_function
def set_anchor(memory: Any, world: int, i: int, P: Any, tick: int):
    """Remember where the vehicle is, for a search after a loss."""
    here = Estimate(memory.member[world, i, 0].pose, P)
    memory.anchor[world, i] = Anchor(here, memory.belief[world, i].odometry, tick)


@wp.func
def is_sound(estimate: Estimate):
    """Return whether an estimate is finite and its covariance positive definite, but for rounding."""
    P = estimate.P
    for k in range(6):
        P[k, k] = P[k, k] * (wp.float64(1.0) + wp.float64(constants.ROUNDING))
    factor = inverse_factor(P)
    return wp.isfinite(wp.trace(factor) + wp.length(estimate.pose.p) + wp.trace(estimate.pose.R))


@device_function
def lose(model: Any, memory: Any, world: int, i: int, tick: int):
    """Search anew, from where most bearings fitted, carried on by odometry since."""
    forget_evidence(memory, world, i)
    anchor = memory.anchor[world, i]
    elapsed = wp.float64(tick - anchor.tick) * model.camera_period
    step = between(anchor.odometry, memory.belief[world, i].odometry)
    begin_errors(model, memory, world, i)  # what was believed of them may be as wrong
    noise = odometry_noise(model, i, elapsed) + lasting_noise(memory, world, i, step, elapsed, elapsed)
    begin_search(memory, world, i, carried(anchor.estimate, step, noise))


@device_function
def update(model: Any, state: Any, memory: Any, world: int, i: int, now: Any, frame: Frame):
    """Correct the belief by every bearing of a frame that fits it; search anew when most do not."""
    share, fitting, nis = gate(frame, memory, world, i)
    state.nis[world, i] = nis
    state.nis_dof[world, i] = 2 * fitting
    if fitting > 0:
        iterated_update(frame, memory, world, i)
        test_words(frame, memory, world, i, now)
    if share < wp.float64(0.0):
        return
    weight = wp.min(wp.float64(1.0), now.period / wp.float64(constants.LOST_TIME))
    missed = memory.belief[world, i].missed_share + (share - memory.belief[world, i].missed_share) * weight
    healthy = memory.belief[world, i].healthy_time + now.period
    if missed >= wp.float64(constants.HEALTHY_SHARE):
        healthy = wp.float64(0.0)
    memory.belief[world, i].missed_share = missed
    test_missed(memory, world, i, frame.lines, now.period)
    memory.belief[world, i].healthy_time = healthy
    if missed > wp.float64(constants.LOST_SHARE):
        lose(model, memory, world, i, now.tick)
    elif healthy > wp.float64(constants.HEALTHY_TIME) and is_sound(own_estimate(memory, world, i)):
        noise = vec2d(wp.float64(constants.ANCHOR_ANGLE_VARIANCE), wp.float64(constants.ANCHOR_POSITION_VARIANCE))
        set_anchor(memory, world, i, with_noise(wp.float64(4.0) * memory.P[world, i, 0, 0], noise), now.tick)


@device_function
def weight_of(memory: Any, world: int, i: int, n: int):
    """Return the weight of a bearing, to whose variance the error of the member that it is to adds."""
    N = memory.line[world, n].noise * wp.identity(2, wp.float64)
    member = memory.line[world, n].member
    if member > 0:
        G = memory.line[world, n].member_jacobian
        N = N + (G * memory.P[world, i, member, member]) * wp.transpose(G)
    return wp.inverse(N)


@device_function
def write_resected_covariance(memory: Any, world: int, i: int, lines: int, inverse: Any):
    """Set the vehicle's covariance to that of the solution, the members' errors included."""
    members = memory.belief[world, i].members
    own = mat66d()
    for k in range(members):
        memory.scratch[world, k].column = mat66d()
    for n in range(lines):
        line = memory.line[world, n]
        if line.fits == 1:
            HtW = wp.transpose(line.jacobian) * weight_of(memory, world, i, n)
            own += (HtW * wp.transpose(HtW)) * line.noise
            if line.member > 0:
                memory.scratch[world, line.member].column += HtW * line.member_jacobian
    for k in range(1, members):
        cross = mat66d()
        for j in range(1, members):
            cross += memory.scratch[world, j].column * memory.P[world, i, j, k]
        own += cross * wp.transpose(memory.scratch[world, k].column)
        block = -(inverse * cross)
        memory.P[world, i, 0, k] = block
        memory.P[world, i, k, 0] = wp.transpose(block)
    memory.P[world, i, 0, 0] = symmetric_part(inverse * own * wp.transpose(inverse))


@device_function
def resect(frame: Frame, memory: Any, world: int, i: int) -> bool:
    """Put the vehicle where a frame's bearings see it, by least squares from where it is; return whether that works."""
    lines = frame.lines
    inverse = mat66d()
    for step in range(constants.GAUSS_NEWTON_STEPS):
        _, fitting, _ = gate(frame, memory, world, i)
        M = mat66d()
        b = vec6d()
        for n in range(lines):
            if memory.line[world, n].fits == 1:
                H = memory.line[world, n].jacobian
                HtW = wp.transpose(H) * weight_of(memory, world, i, n)
                M += HtW * H
                b += HtW * memory.line[world, n].residual
        if fitting < 3:
            return False
        inverse = inverse6(M)
        if not is_regular(M, inverse, wp.float64(constants.MAX_CONDITION)):
            return False
        if step < constants.GAUSS_NEWTON_STEPS - 1:
            apply_error(memory, world, i, 0, inverse * b)
    write_resected_covariance(memory, world, i, lines, inverse)
    return True
