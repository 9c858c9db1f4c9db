"""Kernels of the differentiable rollout: every launch writes arrays of its own, so that a tape can run backwards.

They call the stages' own functions. Sums over targets are atomic additions from one thread per target, because Warp
does not differentiate through variables that a dynamic loop changes.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, join6
from coopenv.estimation.so3 import exp_so3, increment, orthonormalise
from coopenv.observers.riccati.equations import accumulate_information, correct_kalman, predict_covariance, predict_pose
from coopenv.world.camera import VISIBLE, sight_of
from coopenv.world.command import command_of
from coopenv.world.dynamics import bicycle_step, prescribe, yaw_rate
from coopenv.world.model import PRESCRIBED
from coopenv.world.precision import precision

scalar, vec2, vec3, vec4, mat33, mat66 = (
    getattr(precision("float64"), name) for name in ("scalar", "vec2", "vec3", "vec4", "mat33", "mat66")
)


@wp.struct
class Truth:
    """True motion at one instant."""

    rotation: mat33
    position: vec3
    speed: scalar
    steering: scalar


@wp.struct
class Held:
    """The odometry sample in force, and the increment since the last tick."""

    velocity: vec3
    angular_velocity: vec3
    rotation: mat33
    translation: vec3


@wp.struct
class Belief:
    """What an observer believes."""

    rotation: mat33
    position: vec3
    covariance: mat66


@wp.struct
class Information:
    """M = C^T Q C in blocks and r = C^T Q (y - C_2 phat), summed over the targets in view, (W, N)."""

    M11: wp.array2d(dtype=mat33)
    M12: wp.array2d(dtype=mat33)
    M22: wp.array2d(dtype=mat33)
    r1: wp.array2d(dtype=vec3)
    r2: wp.array2d(dtype=vec3)


def command_kernel(model: Any, action: wp.array2d(dtype=Any), command: wp.array2d(dtype=Any)):
    """Make every vehicle's command of its action."""
    world, vehicle = wp.tid()
    levels = action[world, vehicle]
    command[world, vehicle] = command_of(model.dynamics[vehicle], levels[0], levels[1], scalar(0.0))


def drive_kernel(
    model: Any,
    truth: Any,
    command: wp.array2d(dtype=Any),
    held: Any,
    first: int,
    sample: int,
    dt: wp.float64,
    truth_after: Any,
    held_after: Any,
):
    """Move every vehicle for dt under its command and append the held odometry sample; then take a new one if due.

    The `first` step of a tick begins a new increment.
    """
    world, vehicle = wp.tid()
    now = truth[world, vehicle]
    limits = model.dynamics[vehicle]
    R, position, speed, steering = bicycle_step(
        limits, now.rotation, now.position, now.speed, now.steering, command[world, vehicle], dt, 0
    )
    truth_after[world, vehicle] = Truth(R, position, speed, steering)
    odometry = held[world, vehicle]
    v = odometry.velocity
    w = odometry.angular_velocity
    if first != 0:
        rotation, translation = increment(wp.identity(3, scalar), vec3(), v, w, dt)
    else:
        rotation, translation = increment(odometry.rotation, odometry.translation, v, w, dt)
    if sample != 0:
        v = vec3(speed, scalar(0.0), scalar(0.0))
        w = vec3(scalar(0.0), scalar(0.0), yaw_rate(limits, speed, steering))
    held_after[world, vehicle] = Held(v, w, rotation, translation)


def predict_kernel(model: Any, held: Any, before: Any, after: Any, dt: wp.float64):
    """Carry every vehicle's belief through one tick of odometry."""
    world, vehicle = wp.tid()
    belief = before[world, vehicle]
    step = held[world, vehicle]
    R, p = predict_pose(belief.rotation, belief.position, step.rotation, step.translation)
    P = belief.covariance
    E = wp.transpose(step.rotation)
    v1, v2 = model.observer.v1 * dt, model.observer.v2 * dt
    A, B, D = predict_covariance(E, block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3), v1, v2)
    after[world, vehicle] = Belief(R, p, join6(A, B, wp.transpose(B), D))


def inform_kernel(model: Any, state: Any, truth: Any, predicted: Any, corrected: Any, vehicle: int, sums: Any):
    """Add what one target in view tells one vehicle. Grid: (worlds, its targets).

    `state` holds the same truth, to tell what is in view; leaders have their corrected belief of this tick already.
    """
    world, n = wp.tid()
    target = model.targets[vehicle, n]
    own = truth[world, vehicle]
    camera = model.camera[vehicle]
    origin = own.position + own.rotation * camera.position
    marker = model.scene.marker[target]
    place = state.position[world, target] + state.rotation[world, target] * marker
    known = place
    if target >= model.landmarks:
        other = target - model.landmarks
        place = truth[world, other].position + truth[world, other].rotation * marker
        known = corrected[world, other].rotation * (corrected[world, other].position + marker)
    line = place - origin
    b = wp.transpose(own.rotation) * wp.normalize(line)
    in_camera = wp.transpose(camera.rotation) * b
    if sight_of(model, state, world, vehicle, target, origin, line, in_camera) == VISIBLE:
        a = wp.transpose(predicted[world, vehicle].rotation) * known
        e = a - camera.position - predicted[world, vehicle].position
        o = type(own.rotation)()
        M11, M12, M22, r1, r2 = accumulate_information(a, b, e, model.observer.q[target], o, o, o, type(e)(), type(e)())
        wp.atomic_add(sums.M11, world, vehicle, M11)
        wp.atomic_add(sums.M12, world, vehicle, M12)
        wp.atomic_add(sums.M22, world, vehicle, M22)
        wp.atomic_add(sums.r1, world, vehicle, r1)
        wp.atomic_add(sums.r2, world, vehicle, r2)


def correct_kernel(predicted: Any, sums: Any, after: Any, vehicle: int, dt: wp.float64, turn: wp.array(dtype=scalar)):
    """Correct one vehicle's belief over one tick."""
    world = wp.tid()
    belief = predicted[world, vehicle]
    R = belief.rotation
    P = belief.covariance
    L11, L21, L22, _, _ = cholesky6(block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3))
    M11 = sums.M11[world, vehicle]
    M12 = sums.M12[world, vehicle]
    M22 = sums.M22[world, vehicle]
    dx1, dx2, A, B, D = correct_kalman(
        dt, M11, M12, M22, L11, L21, L22, sums.r1[world, vehicle], sums.r2[world, vehicle]
    )
    wp.atomic_max(turn, 0, wp.length(dx1))
    P_after = join6(A, B, wp.transpose(B), D)
    after[world, vehicle] = Belief(orthonormalise(R * exp_so3(dx1)), belief.position + dx2, P_after)


def trace_kernel(after: Any, total: wp.array(dtype=Any)):
    """Add up trace P over vehicles and worlds."""
    world, vehicle = wp.tid()
    wp.atomic_add(total, 0, wp.trace(after[world, vehicle].covariance))


def show_kernel(model: Any, truth: Any, state: Any, t: wp.float64):
    """Write the truth of time t into the world's state, where visibility reads it. Grid: (worlds, agents)."""
    world, agent = wp.tid()
    if agent >= model.landmarks:
        state.rotation[world, agent] = truth[world, agent - model.landmarks].rotation
        state.position[world, agent] = truth[world, agent - model.landmarks].position
    elif model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, t)
