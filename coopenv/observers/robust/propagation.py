"""Propagation: odometry increments, and the calibration states of odometry and of the camera's mounting."""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3, orthonormalise, skew, symmetric_part
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import errors_by_rows, moved, odometry_noise, with_noise
from coopenv.observers.robust.belief import propagate, set_block
from coopenv.observers.robust.memory import ERRORS, MOUNTING, Member, Pose, mat33d, mat66d, vec2d, vec3d, vec4d, vec6d
from coopenv.observers.robust.sources import VELOCITY, propagate_sources
from coopenv.world.warp_internals import device_function, subroutine


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

    That of the bias is `least` at least.
    """
    deviations = wp.max(vec3d(bias), vec3d(least))
    errors = vec4d(deviations[0], deviations[1], deviations[2], wp.float64(scale))
    return wp.cw_mul(errors, errors)


@device_function
def begin_errors(model: Any, memory: Any, world: int, i: int):
    """Begin the calibration states of odometry, member 1, and of the mounting, member 2, if its errors are declared."""
    noise = model.noise[i]
    odometry = odometry_variances(noise.gyro_bias, wp.float64(constants.GYRO_BIAS), noise.odometry_scale)
    mounting = mounting_variances(model, i)
    one = wp.float64(1.0)  # entries without a state are arbitrary
    begin_calibration(memory, world, i, ERRORS, vec6d(odometry[0], odometry[1], odometry[2], odometry[3], one, one))
    if wp.max(mounting) > wp.float64(0.0):
        variances = vec6d(mounting[0], mounting[0], mounting[0], mounting[1], mounting[1], mounting[1])
        begin_calibration(memory, world, i, MOUNTING, variances)


@device_function
def walk_errors(model: Any, memory: Any, world: int, i: int, dt: Any):
    """Inflate the covariances of the calibration states by their walk over dt.

    Those of the odometry walk as declared and as found, see `Source`; the mounting, see `CALIBRATION_CHANGE`.
    """
    noise = model.noise[i]
    walk = odometry_variances(noise.gyro_bias_walk, wp.float64(constants.GYRO_BIAS_WALK), noise.odometry_scale_walk)
    walk[3] += memory.source[world, i, VELOCITY].walk
    for k in range(4):
        memory.P[world, i, ERRORS, ERRORS][k, k] += walk[k] * dt
    if mounting_of(memory, world, i) > 0:
        share = wp.float64(constants.CALIBRATION_CHANGE * constants.CALIBRATION_CHANGE) * dt
        P = memory.P[world, i, MOUNTING, MOUNTING]
        memory.P[world, i, MOUNTING, MOUNTING] = with_noise(P, share * mounting_variances(model, i))


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

    The velocity is the mean of a second (m/s, body), not the measured one, whose noise is in the pose's error as well:
    regressing one on the other would give a scale error of the ratio of noise to velocity, squared.
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

    The recent mean velocity is stored for `errors_transition`. Samples are held until the next one, so that their sum
    lags by half a period. Half the change of the held sample makes it the trapezoidal rule: (v0 + v1) T / 2 = v0 T +
    (v1 - v0) T / 2. The next sample removes the noise that this adds.
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
    else:
        memory.belief[world, i].mean_v = v
    memory.belief[world, i].has_sample = 1
    memory.belief[world, i].sample_v = v
    memory.belief[world, i].sample_w = w
    step = corrected(memory, world, i, Pose(R, p), dt)
    memory.belief[world, i].odometry = moved(memory.belief[world, i].odometry, step)
    return step, noise
