"""The joint state of the vehicle itself and of the vehicles that it receives, with one covariance, and its propagation.

Errors are left errors, R = Rhat Exp(theta), p = phat + Rhat rho, six per member, the vehicle itself first. The
covariance is kept in blocks of 6x6. A member's pose is the one of its last fused report. If a new member needs room,
the member that has been out of view for longest is evicted. Calibration states are members too: one of the odometry's
errors, of the focal length and of the latency of frames, and one of the camera's mounting.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3, orthonormalise, skew, symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import (
    Pose,
    PoseEstimate,
    diagonal_by_rows,
    displaced,
    errors_by_rows,
    forward,
    mat33d,
    mat66d,
    moved,
    odometry_noise,
    propagated,
    recentred,
    recentring,
    vec2d,
    vec3d,
    vec4d,
    vec6d,
    with_noise,
)
from coopenv.observers.robust.memory import ERRORS, MOUNTING, SENDER_SLOTS, Anchor, Member
from coopenv.observers.robust.sources import VELOCITY, is_seen, propagate_sources
from coopenv.world.nearby import agent_of, entry_at, entry_count
from coopenv.world.warp_internals import device_function, subroutine


@device_function
def index_of(memory: Any, world: int, i: int, vehicle: int) -> int:
    """Return the index of a vehicle among the members of i's belief, 0 if it is none, or i itself."""
    for n in range(memory.belief[world, i].first_sender, memory.belief[world, i].members):
        if memory.member[world, i, n].vehicle == vehicle:
            return n
    return 0


@device_function
def set_block(memory: Any, world: int, i: int, k: int, j: int, block: Any):
    """Set the covariance at (k, j) to a block and at (j, k) to its transpose; on the diagonal to the symmetric part."""
    memory.P[world, i, k, j] = block
    memory.P[world, i, j, k] = wp.transpose(block)
    if k == j:
        memory.P[world, i, k, k] = symmetric_part(block)


@device_function
def begin_belief(memory: Any, world: int, i: int, estimate: PoseEstimate):
    """Begin the belief with the vehicle itself; the calibration states are kept without correlations."""
    memory.belief[world, i].members = memory.belief[world, i].first_sender
    for k in range(1, memory.belief[world, i].first_sender):
        for j in range(k):
            set_block(memory, world, i, k, j, mat66d())
    memory.member[world, i, 0].vehicle = i
    memory.member[world, i, 0].pose = estimate.pose
    memory.P[world, i, 0, 0] = estimate.P


@device_function
def own_estimate(memory: Any, world: int, i: int):
    """Return the own estimate."""
    return PoseEstimate(memory.member[world, i, 0].pose, memory.P[world, i, 0, 0])


@subroutine
def propagate(memory: Any, world: int, i: int, n: int, step: Pose, noise: Any):
    """Propagate a member by an increment of odometry with noise."""
    memory.member[world, i, n].pose = moved(memory.member[world, i, n].pose, step)
    for k in range(memory.belief[world, i].members):
        if k != n:
            set_block(memory, world, i, n, k, forward(step, memory.P[world, i, n, k]))
    memory.P[world, i, n, n] = with_noise(propagated(memory.P[world, i, n, n], step), noise)


@device_function
def recentre(memory: Any, world: int, i: int, n: int, G: Any):
    """Recentre the covariance of a member's error about its moved pose, see `recentring`."""
    for k in range(memory.belief[world, i].members):
        if k != n:
            set_block(memory, world, i, n, k, diagonal_by_rows(G, memory.P[world, i, n, k]))
    memory.P[world, i, n, n] = symmetric_part(recentred(G, memory.P[world, i, n, n]))


@subroutine
def apply_corrections(memory: Any, world: int, i: int):
    """Apply the corrections of all estimated members, and recentre the covariance about the new poses.

    Senders are considered: they keep their reported poses.
    """
    for k in range(memory.belief[world, i].first_sender):
        correction = memory.scratch[world, i, k].correction
        if k == ERRORS:
            memory.member[world, i, k].w += correction[:3]
            memory.member[world, i, k].v += correction[3:]
        else:
            memory.member[world, i, k].pose = displaced(memory.member[world, i, k].pose, correction)
            memory.scratch[world, i, k].recentring = recentring(correction)
            recentre(memory, world, i, k, memory.scratch[world, i, k].recentring)


@device_function
def remove_member(memory: Any, world: int, i: int, n: int):
    """Remove a member; later members move up."""
    members = memory.belief[world, i].members
    for m in range(n + 1, members):
        memory.member[world, i, m - 1] = memory.member[world, i, m]
        for k in range(members):
            memory.P[world, i, m - 1, k] = memory.P[world, i, m, k]
    for m in range(n + 1, members):
        for k in range(members):
            memory.P[world, i, k, m - 1] = memory.P[world, i, k, m]
    memory.belief[world, i].members = members - 1


@device_function
def insert_member(memory: Any, world: int, i: int, n: int):
    """Make room at n for a member with an independent error; members from n on move down."""
    members = memory.belief[world, i].members
    for j in range(members - n):
        m = members - j
        memory.member[world, i, m] = memory.member[world, i, m - 1]
        for k in range(members):
            memory.P[world, i, m, k] = memory.P[world, i, m - 1, k]
    for j in range(members - n):
        m = members - j
        for k in range(members + 1):
            memory.P[world, i, k, m] = memory.P[world, i, k, m - 1]
    memory.belief[world, i].members = members + 1
    for k in range(members + 1):
        set_block(memory, world, i, n, k, mat66d())


@device_function
def mark_seen(model: Any, state: Any, memory: Any, world: int, i: int, tick: int):
    """Note which members are in view."""
    kept = model.kept
    for n in range(entry_count(model, state, world, i)):
        entry = entry_at(model, state, kept, world, i, n)
        target = agent_of(state, kept, world, i, entry)
        if target >= model.landmarks and is_seen(state, world, i, entry, tick):
            member = index_of(memory, world, i, target - model.landmarks)
            if member > 0:
                memory.member[world, i, member].seen_tick = tick


@device_function
def make_room(model: Any, memory: Any, world: int, i: int, tick: int) -> bool:
    """Return whether there is room for another member, after an eviction if needed and possible.

    Evicted is the member that has been out of view for longest, unless that is within `VALID_TIME`.
    """
    first = memory.belief[world, i].first_sender
    members = memory.belief[world, i].members
    if members - first < SENDER_SLOTS:
        return True
    longest_unseen = int(first)
    for n in range(first + 1, members):
        if memory.member[world, i, n].seen_tick < memory.member[world, i, longest_unseen].seen_tick:
            longest_unseen = n
    unseen = wp.float64(tick - memory.member[world, i, longest_unseen].seen_tick) * model.camera_period
    if unseen <= wp.float64(constants.VALID_TIME):
        return False
    remove_member(memory, world, i, longest_unseen)
    return True


@device_function
def set_anchor(memory: Any, world: int, i: int, P: Any, tick: int):
    """Store the own pose as the anchor: the prior of a search after a loss."""
    here = PoseEstimate(memory.member[world, i, 0].pose, P)
    memory.anchor[world, i] = Anchor(here, memory.belief[world, i].odometry, tick)


@device_function
def mounting_variances(model: Any, i: int):
    """Return the variances, as declared, of the turn and of the shift, per axis."""
    turn = wp.float64(model.camera[i].orientation_std)
    shift = wp.float64(model.camera[i].position_std)
    return vec2d(turn * turn, shift * shift)


@device_function
def begin_calibration(memory: Any, world: int, i: int, n: int, variances: Any):
    """Begin calibration state n with declared variances (6,)."""
    memory.belief[world, i].first_sender = n + 1
    calibration = Member()
    calibration.vehicle = i
    calibration.pose.R = wp.identity(3, wp.float64)
    memory.member[world, i, n] = calibration
    least = vec6d(wp.float64(constants.MIN_VARIANCE))
    memory.P[world, i, n, n] = wp.diag(wp.max(variances, least))


@device_function
def mounting_of(memory: Any, world: int, i: int) -> int:
    """Return the member with the calibration state of the mounting, 0 if there is none."""
    return wp.where(memory.belief[world, i].first_sender > MOUNTING, MOUNTING, 0)


TWELFTH = 1.0 / 12.0


@wp.func
def odometry_variances(bias: Any, least: wp.float64, scale: Any):
    """Return the variances (4,) of the gyro's bias per axis and of the odometry's scale, by declared deviations.

    The bias has at least the variance `least`.
    """
    deviations = wp.max(vec3d(bias), vec3d(least))
    errors = vec4d(deviations[0], deviations[1], deviations[2], wp.float64(scale))
    return wp.cw_mul(errors, errors)


@device_function
def begin_errors(model: Any, memory: Any, world: int, i: int):
    """Begin the calibration states of odometry and frames, member 1, and of a mounting with errors, member 2."""
    noise = model.noise[i]
    odometry = odometry_variances(noise.gyro_bias, wp.float64(constants.GYRO_BIAS), noise.odometry_scale)
    mounting = mounting_variances(model, i)
    focal = wp.float64(model.camera[i].focal_std)
    latency = wp.float64(model.camera[i].latency_std)
    variances = vec6d(odometry[0], odometry[1], odometry[2], odometry[3], focal * focal, latency * latency)
    begin_calibration(memory, world, i, ERRORS, variances)
    if wp.max(mounting) + wp.float64(model.camera[i].orientation_walk) > wp.float64(0.0):
        variances = vec6d(mounting[0], mounting[0], mounting[0], mounting[1], mounting[1], mounting[1])
        begin_calibration(memory, world, i, MOUNTING, variances)


@device_function
def walk_errors(model: Any, memory: Any, world: int, i: int, dt: Any):
    """Inflate the covariances of the calibration states by their walk over dt.

    Errors walk as declared; the odometry's scale also as estimated, see `SourceMonitor`, and the mounting by
    `CALIBRATION_CHANGE`.
    """
    noise = model.noise[i]
    walk = odometry_variances(noise.gyro_bias_walk, wp.float64(constants.GYRO_BIAS_WALK), noise.odometry_scale_walk)
    walk[3] += memory.source[world, i, VELOCITY].walk
    for k in range(4):
        memory.P[world, i, ERRORS, ERRORS][k, k] += walk[k] * dt
    if mounting_of(memory, world, i) > 0:
        share = wp.float64(constants.CALIBRATION_CHANGE * constants.CALIBRATION_CHANGE) * dt
        gained = share * mounting_variances(model, i)
        turning = wp.float64(model.camera[i].orientation_walk)
        gained[0] += turning * turning * dt
        P = memory.P[world, i, MOUNTING, MOUNTING]
        memory.P[world, i, MOUNTING, MOUNTING] = with_noise(P, gained)


@device_function
def corrected(memory: Any, world: int, i: int, step: Pose, dt: Any):
    """Return an increment over dt without the estimated errors, to first order in the bias."""
    bias = memory.member[world, i, ERRORS].w
    scale = wp.float64(1.0) + memory.member[world, i, ERRORS].v[0]
    turn = bias * dt
    return Pose(step.R * exp_so3(-turn), (step.p - wp.float64(0.5) * wp.cross(turn, step.p)) / scale)


@device_function
def errors_transition(memory: Any, world: int, i: int, step: Pose, dt: Any):
    """Return the derivative, 6x6, of the left error after a corrected increment by the odometry's errors.

    The velocity is the mean of a second (m/s, body). The noise of the measured one is also in the pose's error:
    a regression on it would give a scale error of the ratio of noise to velocity, squared.
    Source: errors in variables, Fuller, Measurement Error Models, 1987, section 1.1.
    """
    scale = wp.float64(1.0) + memory.member[world, i, ERRORS].v[0]
    p = (dt / scale) * memory.belief[world, i].mean_v
    Rt = wp.transpose(step.R)
    G = mat66d()
    for k in range(3):
        G[k, k] = -dt
    G[3:, :3] = Rt * skew((wp.float64(0.5) * dt) * p)
    along = -(Rt * p) / scale
    for k in range(3):
        G[k + 3, 3] = along[k]
    return G


@subroutine
def propagate_own(memory: Any, world: int, i: int, step: Pose, noise: Any, dt: Any):
    """Propagate the own pose by a corrected increment over dt, with noise and the remaining calibration errors."""
    propagate(memory, world, i, 0, step, noise)
    G = errors_transition(memory, world, i, step, dt)
    for k in range(memory.belief[world, i].members):
        coupled = errors_by_rows(G, memory.P[world, i, ERRORS, k])
        if k > 0:
            set_block(memory, world, i, 0, k, memory.P[world, i, 0, k] + coupled)
        else:
            own = errors_by_rows(G, wp.transpose(errors_by_rows(G, memory.P[world, i, ERRORS, ERRORS])))
            both = coupled + wp.transpose(coupled) + own
            memory.P[world, i, 0, 0] = symmetric_part(memory.P[world, i, 0, 0] + both)
    propagate_sources(memory, world, i, step, G, dt)


@device_function
def increment_noise(model: Any, memory: Any, world: int, i: int, step: Pose, dt: Any, correlated: Any):
    """Return the variances (rotation, translation) of an increment over dt, with the odometry's calibration as noise.

    The calibration errors have the covariance of the vehicle's own ones. They add up like noise that is constant over
    the time `correlated`, s.
    """
    P = memory.P[world, i, ERRORS, ERRORS]
    time = wp.max(correlated, dt)
    turning = wp.max(wp.max(P[0, 0], P[1, 1]), P[2, 2]) * dt * time
    driving = P[3, 3] * wp.length_sq(step.p) * time / wp.max(dt, wp.float64(constants.SAME_TIME))
    return odometry_noise(model, i, dt) + vec2d(turning, driving)


@wp.func
def jump_variance(change: Any, std: Any, period: Any):
    """Return the variance, per axis, of an increment in which the twist has changed by `change` between two samples.

    A change beyond the samples' noise and a smooth acceleration is sudden, as in a collision, at any time.
    """
    square = wp.dot(change, change)
    smooth = wp.float64(constants.MAX_SMOOTH_ACCELERATION)
    gate = wp.max(wp.float64(constants.JUMP_GATE) * std * std, smooth * smooth * period * period)
    return wp.where(square > gate, square * period * period * wp.float64(TWELFTH), wp.float64(0.0))


@subroutine
def take_odometry(model: Any, state: Any, memory: Any, world: int, i: int, dt: Any):
    """Return the increment over a tick of dt and variances to add to its noise; propagate the dead reckoning.

    The recent mean twist is stored for `errors_transition` and `approach`. Samples are held until the next one, so that
    their sum lags by half a period. Half the change of the held sample makes it the trapezoidal rule: (v0 + v1) T / 2 =
    v0 T + (v1 - v0) T / 2. The next sample removes the noise that this adds.
    """
    v = vec3d(state.odometry_velocity[world, i])
    w = vec3d(state.odometry_angular_velocity[world, i])
    R = orthonormalise(mat33d(state.increment_rotation[world, i]))
    p = vec3d(state.increment_translation[world, i])
    noise = vec2d()
    if memory.belief[world, i].has_sample == 1:
        change_v = v - memory.belief[world, i].sample_v
        change_w = w - memory.belief[world, i].sample_w
        half = wp.float64(0.5) * model.odometry_period
        p = p + R * (half * change_v)
        R = R * exp_so3(half * change_w)
        period = model.odometry_period
        noise[0] = jump_variance(change_w, wp.float64(model.noise[i].angular_velocity), period)
        noise[1] = jump_variance(change_v, wp.float64(model.noise[i].velocity), period)
        share = dt / (dt + wp.float64(constants.MEAN_TIME))
        memory.belief[world, i].mean_v += share * (v - memory.belief[world, i].mean_v)
        memory.belief[world, i].mean_w += share * (w - memory.belief[world, i].mean_w)
    else:
        memory.belief[world, i].mean_v = v
        memory.belief[world, i].mean_w = w
    memory.belief[world, i].has_sample = 1
    memory.belief[world, i].sample_v = v
    memory.belief[world, i].sample_w = w
    step = corrected(memory, world, i, Pose(R, p), dt)
    memory.belief[world, i].odometry = moved(memory.belief[world, i].odometry, step)
    return step, noise
