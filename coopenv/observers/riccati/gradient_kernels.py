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

scalar, vec2, vec3, mat33, mat66 = (
    getattr(precision("float64"), name) for name in ("scalar", "vec2", "vec3", "mat33", "mat66")
)


@wp.struct
class Truth:
    """True motion at one instant, (W, N)."""

    rotation: wp.array2d(dtype=mat33)
    position: wp.array2d(dtype=vec3)
    speed: wp.array2d(dtype=scalar)
    steering: wp.array2d(dtype=scalar)


@wp.struct
class Held:
    """The odometry sample in force, and the increment since the last tick, (W, N)."""

    velocity: wp.array2d(dtype=vec3)
    angular_velocity: wp.array2d(dtype=vec3)
    rotation: wp.array2d(dtype=mat33)
    translation: wp.array2d(dtype=vec3)


@wp.struct
class Belief:
    """What the observers believe, (W, N)."""

    rotation: wp.array2d(dtype=mat33)
    position: wp.array2d(dtype=vec3)
    covariance: wp.array2d(dtype=mat66)


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
    command[world, vehicle] = command_of(model, action[world, vehicle])


def drive_kernel(
    model: Any,
    truth: Any,
    command: wp.array2d(dtype=Any),
    held: Any,
    sample: int,
    dt: wp.float64,
    truth_after: Any,
    held_after: Any,
):
    """Move every vehicle for dt under its command and append the held odometry sample; then take a new one if due."""
    world, vehicle = wp.tid()
    R, position, speed, steering = bicycle_step(
        model,
        truth.rotation[world, vehicle],
        truth.position[world, vehicle],
        truth.speed[world, vehicle],
        truth.steering[world, vehicle],
        command[world, vehicle],
        dt,
        0,
    )
    truth_after.rotation[world, vehicle] = R
    truth_after.position[world, vehicle] = position
    truth_after.speed[world, vehicle] = speed
    truth_after.steering[world, vehicle] = steering
    v = held.velocity[world, vehicle]
    w = held.angular_velocity[world, vehicle]
    rotation, translation = increment(held.rotation[world, vehicle], held.translation[world, vehicle], v, w, dt)
    held_after.rotation[world, vehicle] = rotation
    held_after.translation[world, vehicle] = translation
    o = position - position
    if sample != 0:
        held_after.velocity[world, vehicle] = type(o)(speed, o[1], o[2])
        held_after.angular_velocity[world, vehicle] = type(o)(o[0], o[1], yaw_rate(model, speed, steering))
    else:
        held_after.velocity[world, vehicle] = v
        held_after.angular_velocity[world, vehicle] = w


def predict_kernel(model: Any, held: Any, before: Any, after: Any, dt: wp.float64):
    """Carry every vehicle's belief through one tick of odometry."""
    world, vehicle = wp.tid()
    R, p = predict_pose(
        before.rotation[world, vehicle],
        before.position[world, vehicle],
        held.rotation[world, vehicle],
        held.translation[world, vehicle],
    )
    P = before.covariance[world, vehicle]
    o = R - R
    A, B, D = predict_covariance(
        wp.transpose(held.rotation[world, vehicle]),
        block3(P, 0, 0, o),
        block3(P, 0, 3, o),
        block3(P, 3, 3, o),
        model.observer.v1 * dt,
        model.observer.v2 * dt,
    )
    after.rotation[world, vehicle] = R
    after.position[world, vehicle] = p
    after.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D, P - P)


def inform_kernel(model: Any, state: Any, truth: Any, predicted: Any, corrected: Any, vehicle: int, sums: Any):
    """Add what one target in view tells one vehicle. Grid: (worlds, its targets).

    `state` holds the same truth, to tell what is in view; leaders have their corrected belief of this tick already.
    """
    world, n = wp.tid()
    target = model.targets[vehicle, n]
    own_R = truth.rotation[world, vehicle]
    origin = truth.position[world, vehicle] + own_R * model.camera.position
    marker = model.scene.marker[target]
    place = state.position[world, target] + state.rotation[world, target] * marker
    known = place
    if target >= model.landmarks:
        other = target - model.landmarks
        place = truth.position[world, other] + truth.rotation[world, other] * marker
        known = corrected.rotation[world, other] * (corrected.position[world, other] + marker)
    line = place - origin
    b = wp.transpose(own_R) * wp.normalize(line)
    in_camera = wp.transpose(model.camera.rotation) * b
    if sight_of(model, state, world, vehicle, target, origin, line, in_camera) == VISIBLE:
        a = wp.transpose(predicted.rotation[world, vehicle]) * known
        e = a - model.camera.position - predicted.position[world, vehicle]
        o = own_R - own_R
        M11, M12, M22, r1, r2 = accumulate_information(a, b, e, model.observer.q[target], o, o, o, e - e, e - e)
        wp.atomic_add(sums.M11, world, vehicle, M11)
        wp.atomic_add(sums.M12, world, vehicle, M12)
        wp.atomic_add(sums.M22, world, vehicle, M22)
        wp.atomic_add(sums.r1, world, vehicle, r1)
        wp.atomic_add(sums.r2, world, vehicle, r2)


def correct_kernel(predicted: Any, sums: Any, after: Any, vehicle: int, dt: wp.float64, turn: wp.array(dtype=scalar)):
    """Correct one vehicle's belief over one tick."""
    world = wp.tid()
    R = predicted.rotation[world, vehicle]
    P = predicted.covariance[world, vehicle]
    o = R - R
    L11, L21, L22, _, _ = cholesky6(block3(P, 0, 0, o), block3(P, 0, 3, o), block3(P, 3, 3, o))
    dx1, dx2, A, B, D = correct_kalman(
        dt,
        sums.M11[world, vehicle],
        sums.M12[world, vehicle],
        sums.M22[world, vehicle],
        L11,
        L21,
        L22,
        sums.r1[world, vehicle],
        sums.r2[world, vehicle],
    )
    wp.atomic_max(turn, 0, wp.length(dx1))
    after.rotation[world, vehicle] = orthonormalise(R * exp_so3(dx1))
    after.position[world, vehicle] = predicted.position[world, vehicle] + dx2
    after.covariance[world, vehicle] = join6(A, B, wp.transpose(B), D, P - P)


def trace_kernel(after: Any, total: wp.array(dtype=Any)):
    """Add up trace P over vehicles and worlds."""
    world, vehicle = wp.tid()
    wp.atomic_add(total, 0, wp.trace(after.covariance[world, vehicle]))


def show_kernel(model: Any, truth: Any, state: Any, t: wp.float64):
    """Write the truth of time t into the world's state, where visibility reads it. Grid: (worlds, agents)."""
    world, agent = wp.tid()
    if agent >= model.landmarks:
        state.rotation[world, agent] = truth.rotation[world, agent - model.landmarks]
        state.position[world, agent] = truth.position[world, agent - model.landmarks]
    elif model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, t)
