"""What the functions of terms are given: small records of one vehicle at the end of a decision.

A field of the observation gets `Ego`, and `Target` or `Neighbour`: nothing in them depends on the truth but through
what the vehicle measures, hears and does. Only rewards and terminations may ask for `Truth` too, and are then
privileged. A term that keeps to its arguments therefore cannot leak truth into an observation.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from coopenv.world.camera import VISIBLE
from coopenv.world.collision import UNDER_WAY
from coopenv.world.precision import Precision
from coopenv.world.v2x import fresh

NEVER = wp.constant(wp.float64(1.0e9))
"""Age of what has never been measured or heard, s."""


class Records(NamedTuple):
    """The Warp structs of one precision."""

    Ego: Any
    Truth: Any
    Target: Any
    Neighbour: Any


@cache
def records(p: Precision) -> Records:
    """Return the records in one precision."""
    scalar, vec2, vec3, mat33, mat66 = p.scalar, p.vec2, p.vec3, p.mat33, p.mat66

    @wp.struct
    class Ego:
        """What the vehicle itself knows."""

        time: wp.float64  # s since the reset
        elapsed: wp.float32  # s since the last decision
        position_estimate: vec3  # m, map
        rotation_estimate: mat33  # body to map
        covariance: mat66  # P over (2 lambda, p): rad^2, rad m, m^2
        log_determinant: scalar  # of P
        gramian_min_eigenvalue: scalar  # of the sliding observability Gramian
        targets_in_view: wp.int32
        possible_targets: wp.int32  # targets that may be measured
        velocity: vec3  # m/s, last odometry sample, body
        angular_velocity: vec3  # rad/s, last odometry sample, body
        odometry_age: wp.float64  # s
        action: vec2  # of this decision, [-1, 1]
        command: vec3  # what it asked for: speed m/s, steering rad, acceleration m/s^2
        goal: vec3  # m, seen from the estimate, body; 0 without a goal
        outcome: wp.int32  # `Outcome` in the step of arrival or collision, else UNDER_WAY

    @wp.struct
    class Truth:
        """What only a simulation knows; NaN (numbers: 0) where a recording does not."""

        position: vec3  # m, map
        rotation: mat33  # body to map
        velocity: vec3  # m/s, body
        angular_velocity: vec3  # rad/s, body
        position_error: wp.float32  # m
        orientation_error: wp.float32  # deg, geodesic
        nees: wp.float32
        goal_distance: wp.float32  # m, horizontal
        progress: wp.float32  # m nearer to the goal than at the last decision; 0 without a goal
        contact: wp.bool  # touching a building or another body now

    @wp.struct
    class Target:
        """What the vehicle knows of a landmark or another vehicle by its camera."""

        index: wp.int32  # landmarks first, then vehicles
        bearing: vec3  # unit vector camera to target, optical frame, last measured; 0: never
        in_view: wp.bool  # measured in this frame
        age: wp.float64  # s since measured

    @wp.struct
    class Neighbour:
        """What the vehicle knows of another vehicle by its messages; 0 where none is at hand."""

        index: wp.int32  # of the vehicle
        heard: wp.bool  # a message is at hand and not stale
        position: vec3  # m, sender's estimate seen from one's own, body
        rotation: mat33  # sender's body to one's own estimated body
        age: wp.float64  # s since it was sent

    return Records(Ego, Truth, Target, Neighbour)


@wp.func
def known(value: Any) -> wp.float32:
    """Return a quantity of truth, 0 where a recording does not know it."""
    return wp.where(wp.isfinite(value), wp.float32(value), 0.0)


@wp.func
def seconds_since(now: int, then: int, rate: wp.float64) -> wp.float64:
    """Return the age in s of a measurement or message by its tick; very old if there is none."""
    if then < 0:
        return NEVER
    return wp.float64(now - then) / rate


@wp.func
def odometry_age(samples: int, time: wp.float64, rate: wp.float64) -> wp.float64:
    """Return the age in s of the last of so many samples, the first of which was at 0 s."""
    if samples == 0:
        return NEVER
    return wp.max(time - wp.float64(samples - 1) / rate, wp.float64(0.0))


@wp.func
def fill_own(ego: Any, truth: Any, model: Any, state: Any, results: Any, world: int, vehicle: int, goal_distance: Any):
    """Return the records of a vehicle: what it knows, and what is true.

    `results` holds how good its estimate is, and what was so after the last decision. One function for both, as model,
    state and results are handed over by value, over which compilers take their time.
    """
    tick = state.tick[world]
    ego.time = wp.float64(tick) / model.camera_rate
    ego.elapsed = wp.float32(wp.float64(tick - results.last_tick[world, vehicle]) / model.camera_rate)
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    ego.position_estimate = R * p
    ego.rotation_estimate = R
    ego.covariance = state.covariance[world, vehicle]
    ego.log_determinant = results.log_determinant[world, vehicle]
    ego.gramian_min_eigenvalue = results.gramian_min_eigenvalue[world, vehicle]
    ego.targets_in_view = results.targets_in_view[world, vehicle]
    ego.possible_targets = model.target_count[vehicle]
    ego.velocity = state.odometry_velocity[world, vehicle]
    ego.angular_velocity = state.odometry_angular_velocity[world, vehicle]
    ego.odometry_age = odometry_age(state.odometry_samples[world, vehicle], ego.time, model.odometry_rate)
    ego.action = state.action[world, vehicle]
    ego.command = state.command[world, vehicle]
    if model.scene.goal_radius[vehicle] > p.dtype(0.0):
        ego.goal = wp.transpose(R) * model.scene.goal[vehicle] - p
    ego.outcome = wp.where(results.alive[world, vehicle], state.ended[world, vehicle], UNDER_WAY)

    agent = model.landmarks + vehicle
    truth.position = state.position[world, agent]
    truth.rotation = state.rotation[world, agent]
    truth.velocity = state.velocity[world, agent]
    truth.angular_velocity = state.angular_velocity[world, agent]
    truth.position_error = known(results.position_error[world, vehicle])
    truth.orientation_error = known(results.orientation_error[world, vehicle])
    truth.nees = known(results.nees[world, vehicle])
    truth.goal_distance = known(goal_distance)
    if model.scene.goal_radius[vehicle] > goal_distance - goal_distance:
        truth.progress = known(results.last_goal_distance[world, vehicle] - goal_distance)
    truth.contact = state.collided[world, vehicle] != 0
    return ego, truth


@wp.func
def fill_target(target: Any, model: Any, state: Any, world: int, vehicle: int, index: int):
    """Return the record of a target."""
    target.index = index
    target.bearing = state.bearing[world, vehicle, index]
    target.in_view = state.sight[world, vehicle, index] == VISIBLE
    target.age = seconds_since(state.tick[world], state.bearing_tick[world, vehicle, index], model.camera_rate)
    return target


@wp.func
def fill_neighbour(neighbour: Any, model: Any, state: Any, world: int, vehicle: int, sender: int):
    """Return the record of another vehicle."""
    now = state.tick[world]
    neighbour.index = sender
    neighbour.heard = fresh(model, state, world, vehicle, sender, now)
    neighbour.age = NEVER
    if neighbour.heard:
        Rt = wp.transpose(state.estimate_rotation[world, vehicle])
        p = state.estimate_position[world, vehicle]
        neighbour.position = Rt * state.inbox_position[world, vehicle, sender] - p
        neighbour.rotation = Rt * state.inbox_rotation[world, vehicle, sender]
        neighbour.age = seconds_since(now, state.inbox_tick[world, vehicle, sender], model.camera_rate)
    return neighbour
