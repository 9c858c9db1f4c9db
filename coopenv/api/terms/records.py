"""Records from which terms are computed: one vehicle at the end of a decision.

Numbers are float32 in worlds of either precision. A field of the observation takes `Ego`, and `Target`, `Neighbour` or
`MapLandmark`. These depend on the truth only through measurements, received messages and actions. Only reward terms and
terminations may take `Truth`, and are then privileged. Observations therefore cannot leak truth.
"""

from typing import Any

import warp as wp

from coopenv.api.terms.geometry import (
    Nearest,
    estimate_on_route,
    estimated_progress,
    expected_in_view,
    metres,
    route_from_estimate,
)
from coopenv.world.camera import VISIBLE, body_bearing, marker_position
from coopenv.world.dynamics import ACCELERATION, SPEED, STEERING, UNDER_WAY
from coopenv.world.quality import position_covariance
from coopenv.world.route import goal_distance, route_length
from coopenv.world.v2x import fresh
from coopenv.world.warp_internals import device_function

NEVER = wp.constant(wp.float64(1.0e9))
"""Age without any measurement or message, s."""

LOG10_E = wp.constant(0.4342944819032518)

mat66 = wp.types.matrix((6, 6), wp.float32)


@wp.struct
class Ego:
    """The vehicle's own estimate, odometry, action and route."""

    time: wp.float32  # s since the reset
    elapsed: wp.float32  # s since the last decision
    position_estimate: wp.vec3  # m, map
    rotation_estimate: wp.mat33  # body to map
    covariance: mat66  # P over (2 lambda, p): rad^2, rad m, m^2
    log_determinant: wp.float32  # of P
    mean_log_variance: wp.float32  # log det P / 6
    information_gained: wp.float32  # decrease of log det P / 6 since the last decision
    position_std: wp.float32  # m, sqrt of the trace of the position's covariance in the map
    axis_std: wp.vec3  # m, of the position along the estimated body's axes
    heading_std: wp.float32  # rad, of the turn about the body's z axis
    uncertainty_threshold: wp.float32  # m, of [reward]
    uncertainty_cap: wp.float32  # m, of [reward]
    metres_gained: wp.float32  # of its route in this decision, beyond the furthest point so far, by the estimate
    metres_missed: wp.float32  # of its route never driven, in the step that ends its episode without an arrival; else 0
    gramian_min_eigenvalue: wp.float32  # of the sliding observability Gramian
    soft_observability: wp.float32  # log10 of the floor + that eigenvalue
    observability_floor: wp.float32  # log10 of the floor, of [reward]
    observability_level: wp.float32  # log10, of [reward]
    targets_in_view: wp.int32
    possible_targets: wp.int32  # targets that may be measured
    velocity: wp.vec3  # m/s, last odometry sample, body
    angular_velocity: wp.vec3  # rad/s, last odometry sample, body
    odometry_age: wp.float32  # s
    action: wp.vec3  # of this decision, [-1, 1]; the third entry is 0 where cameras do not pan
    effort: wp.float32  # |action|^2
    command: wp.vec3  # the action as speed m/s, steering rad, acceleration m/s^2
    steering: wp.float32  # rad, positive to the left
    pan: wp.float32  # of the camera, rad, positive to the left
    time_left: wp.float32  # share of the horizon
    route_offset: wp.float32  # m to the left of its route, by the estimate
    route_heading: wp.float32  # rad, estimated heading minus the heading of its route
    route_left: wp.float32  # m along its route to the goal
    route_ahead: wp.vec4  # rad to the left, directions of its route 1, 2, 4 and 8 steps ahead
    route_step: wp.float32  # m
    top_speed: wp.float32  # m/s
    goal: wp.vec3  # m, seen from the estimate, body; 0 without a goal
    arrived: wp.int32  # arrivals at a goal in this step
    outcome: wp.int32  # `Outcome` in the step of arrival or collision, else UNDER_WAY


@wp.struct
class Truth:
    """The true state; NaN (numbers: 0) in a recording without it."""

    position: wp.vec3  # m, map
    rotation: wp.mat33  # body to map
    velocity: wp.vec3  # m/s, body
    angular_velocity: wp.vec3  # rad/s, body
    position_error: wp.float32  # m
    orientation_error: wp.float32  # deg, geodesic
    nees: wp.float32
    goal_distance: wp.float32  # m, horizontal
    progress: wp.float32  # decrease of the remaining route in this decision, m; 0 without a goal
    contact: wp.bool  # touching a building or another body now


@wp.struct
class Target:
    """A landmark or another vehicle as measured by the camera."""

    index: wp.int32  # landmarks first, then vehicles
    bearing: wp.vec3  # unit vector camera to target, optical frame, last measured; 0: never
    in_view: wp.bool  # measured in this frame
    age: wp.float32  # s since measured


@wp.struct
class Neighbour:
    """Another vehicle by its last message (0 without one) and as measured by the camera."""

    index: wp.int32  # of the vehicle
    received: wp.bool  # there is a message and it is not stale
    position: wp.vec3  # m, sender's estimate relative to the vehicle's own, body
    rotation: wp.mat33  # sender's body to the vehicle's own estimated body
    age: wp.float32  # s since it was sent
    bearing: wp.vec3  # unit vector camera to the vehicle, body, last measured; 0: never
    in_view: wp.bool  # measured in this frame
    bearing_age: wp.float32  # s since measured


@wp.struct
class MapLandmark:
    """One of the landmarks nearest to the vehicle's own estimate; 0 beyond the end of the map."""

    index: wp.int32  # of the landmark; -1: there is none
    exists: wp.bool
    position: wp.vec3  # m, relative to the estimate, body
    distance: wp.float32  # m, horizontal, from the estimate
    expected: wp.bool  # visible from the estimate: in range, in the image, not occluded
    in_view: wp.bool  # measured in this frame
    bearing: wp.vec3  # unit vector camera to landmark, body, last measured; 0: never
    age: wp.float32  # s since measured


@wp.func
def log10(value: wp.float32) -> wp.float32:
    """Return the decimal logarithm."""
    return wp.log(value) * LOG10_E


@wp.func
def zero_if_unknown(value: Any) -> wp.float32:
    """Return a quantity of the truth, 0 in a recording without it."""
    return wp.where(wp.isfinite(value), wp.float32(value), 0.0)


@wp.func
def seconds_since(now: int, then: int, rate: wp.float64) -> wp.float32:
    """Return the age in s of a measurement or message by its tick; `NEVER` without one."""
    return wp.float32(wp.where(then < 0, NEVER, wp.float64(now - then) / rate))


@wp.func
def odometry_age(samples: int, time: wp.float64, rate: wp.float64) -> wp.float32:
    """Return the age in s of the last of so many samples, the first of which was at 0 s."""
    age = wp.max(time - wp.float64(samples - 1) / rate, wp.float64(0.0))
    return wp.float32(wp.where(samples == 0, NEVER, age))


@device_function
def own_records(model: Any, state: Any, results: Any, world: int, vehicle: int, remaining: Any, route: bool):
    """Return the records `Ego` and `Truth` of a vehicle.

    `results` holds the quality of its estimate and the values after the last decision; `remaining` is the length of its
    route that is left, m. Without `route`, the fields `route_offset` to `route_ahead` stay 0.
    """
    ego = Ego()
    tick = state.tick[world]
    time = wp.float64(tick) / model.camera_rate
    ego.time = wp.float32(time)
    ego.elapsed = wp.float32(wp.float64(tick - results.last_tick[world, vehicle]) / model.camera_rate)
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    ego.position_estimate = wp.vec3(R * p)
    ego.rotation_estimate = wp.mat33(R)
    ego.covariance = mat66(state.covariance[world, vehicle])
    ego.log_determinant = wp.float32(results.log_determinant[world, vehicle])
    ego.mean_log_variance = wp.float32(results.log_determinant[world, vehicle] / p.dtype(6.0))
    last = results.last_log_determinant[world, vehicle]
    ego.information_gained = wp.float32((last - results.log_determinant[world, vehicle]) / p.dtype(6.0))
    ego.position_std = wp.float32(results.position_std[world, vehicle])
    spread = position_covariance(state.covariance[world, vehicle], p)
    for axis in range(3):
        ego.axis_std[axis] = wp.float32(wp.sqrt(wp.max(spread[axis, axis], p.dtype(0.0))))
    ego.heading_std = wp.float32(wp.sqrt(wp.max(state.covariance[world, vehicle][2, 2], p.dtype(0.0))))
    ego.uncertainty_threshold = wp.float32(model.judgement.uncertainty_threshold)
    ego.uncertainty_cap = wp.float32(model.judgement.uncertainty_cap)
    s, offset, along = estimate_on_route(state, world, vehicle)
    progress = estimated_progress(state, world, vehicle, s)
    gained, missed = metres(model, state, results, world, vehicle, progress, wp.float64(ego.elapsed))
    ego.metres_gained = wp.float32(gained)
    ego.metres_missed = wp.float32(missed)
    ego.gramian_min_eigenvalue = wp.float32(results.gramian_min_eigenvalue[world, vehicle])
    floor = wp.float32(model.judgement.observability_floor)
    ego.soft_observability = log10(floor + wp.max(ego.gramian_min_eigenvalue, 0.0))
    ego.observability_floor = log10(floor)
    ego.observability_level = wp.float32(model.judgement.observability_level)
    ego.targets_in_view = results.targets_in_view[world, vehicle]
    ego.possible_targets = model.target_count[vehicle]
    ego.velocity = wp.vec3(state.odometry_velocity[world, vehicle])
    ego.angular_velocity = wp.vec3(state.odometry_angular_velocity[world, vehicle])
    ego.odometry_age = odometry_age(state.odometry_samples[world, vehicle], time, model.odometry_rate)
    first = wp.float32(state.action[world, vehicle, 0])
    second = wp.float32(state.action[world, vehicle, 1])
    third = float(0.0)
    if model.action_size > 2:
        third = wp.float32(state.action[world, vehicle, 2])
    ego.action = wp.vec3(first, second, third)
    ego.effort = wp.length_sq(ego.action)
    command = state.command[world, vehicle]
    ego.command = wp.vec3(wp.float32(command[SPEED]), wp.float32(command[STEERING]), wp.float32(command[ACCELERATION]))
    ego.pan = wp.float32(state.pan[world, vehicle])
    ego.steering = wp.float32(state.steering[world, vehicle])
    ego.time_left = 1.0 - wp.float32(tick) / wp.float32(model.horizon_ticks)
    if route and route_length(state, world, vehicle) > p.dtype(0.0):
        turn, left, ahead = route_from_estimate(model, state, world, vehicle, s, along)
        ego.route_offset = wp.float32(offset)
        ego.route_heading = wp.float32(turn)
        ego.route_left = wp.float32(left)
        ego.route_ahead = ahead
    ego.route_step = wp.float32(model.route_step)
    ego.top_speed = wp.max(wp.float32(model.dynamics[vehicle].max_speed), 1.0e-3)
    if model.scene.goal_radius[vehicle] > p.dtype(0.0):
        ego.goal = wp.vec3(wp.transpose(R) * state.goal[world, vehicle] - p)
    if results.alive[world, vehicle]:
        ego.arrived = state.arrivals[world, vehicle] - results.last_arrivals[world, vehicle]
    ego.outcome = wp.where(results.alive[world, vehicle], state.ended[world, vehicle], UNDER_WAY)

    truth = Truth()
    agent = model.landmarks + vehicle
    truth.position = wp.vec3(state.position[world, agent])
    truth.rotation = wp.mat33(state.rotation[world, agent])
    truth.velocity = wp.vec3(state.velocity[world, agent])
    truth.angular_velocity = wp.vec3(state.angular_velocity[world, agent])
    truth.position_error = zero_if_unknown(results.position_error[world, vehicle])
    truth.orientation_error = zero_if_unknown(results.orientation_error[world, vehicle])
    truth.nees = zero_if_unknown(results.nees[world, vehicle])
    truth.goal_distance = zero_if_unknown(goal_distance(model, state, world, vehicle))
    if model.scene.goal_radius[vehicle] > p.dtype(0.0):
        nearer = results.last_remaining[world, vehicle] - remaining
        if ego.arrived > 0 and ego.outcome == UNDER_WAY:  # on a new route now
            nearer += route_length(state, world, vehicle)
        truth.progress = zero_if_unknown(nearer)
    truth.contact = state.collided[world, vehicle] != 0
    return ego, truth


@device_function
def target_record(model: Any, state: Any, world: int, vehicle: int, index: int) -> Target:
    """Return the record of a target."""
    target = Target()
    target.index = index
    target.bearing = wp.vec3(state.bearing[world, vehicle, index])
    target.in_view = state.sight[world, vehicle, index] == VISIBLE
    target.age = seconds_since(state.tick[world], state.bearing_tick[world, vehicle, index], model.camera_rate)
    return target


@device_function
def neighbour_record(model: Any, state: Any, world: int, vehicle: int, sender: int) -> Neighbour:
    """Return the record of another vehicle."""
    neighbour = Neighbour()
    now = state.tick[world]
    neighbour.index = sender
    neighbour.received = fresh(model, state, world, vehicle, sender, now)
    neighbour.age = wp.float32(NEVER)
    if neighbour.received:
        Rt = wp.transpose(state.estimate_rotation[world, vehicle])
        p = state.estimate_position[world, vehicle]
        neighbour.position = wp.vec3(Rt * state.inbox_position[world, vehicle, sender] - p)
        neighbour.rotation = wp.mat33(Rt * state.inbox_rotation[world, vehicle, sender])
        neighbour.age = seconds_since(now, state.inbox_stamp[world, vehicle, sender], model.camera_rate)
    target = model.landmarks + sender
    neighbour.bearing = wp.vec3(body_bearing(model, state, world, vehicle, target))
    neighbour.in_view = state.sight[world, vehicle, target] == VISIBLE
    neighbour.bearing_age = seconds_since(now, state.bearing_tick[world, vehicle, target], model.camera_rate)
    return neighbour


@device_function
def map_record(model: Any, state: Any, world: int, vehicle: int, place: Nearest) -> MapLandmark:
    """Return the record of a landmark of the map."""
    landmark = MapLandmark()
    landmark.index = place.index
    landmark.age = wp.float32(NEVER)
    if place.index >= 0:
        point = marker_position(model, state, world, place.index)
        Rt = wp.transpose(state.estimate_rotation[world, vehicle])
        landmark.exists = True
        landmark.position = wp.vec3(Rt * point - state.estimate_position[world, vehicle])
        landmark.distance = place.distance
        landmark.expected = expected_in_view(model, state, world, vehicle, point)
        landmark.in_view = state.sight[world, vehicle, place.index] == VISIBLE
        landmark.bearing = wp.vec3(body_bearing(model, state, world, vehicle, place.index))
        then = state.bearing_tick[world, vehicle, place.index]
        landmark.age = seconds_since(state.tick[world], then, model.camera_rate)
    return landmark
