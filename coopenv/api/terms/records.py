"""Records from which terms are computed, one vehicle at the end of a decision, and values of built-in fields.

Numbers are float32 in worlds of either precision. A field of the observation takes `Ego`, and `Target`, `Neighbour` or
`MapLandmark`. These depend on the truth only through measurements, received messages and actions. Only reward terms and
terminations may take `TruthRecord`, reward terms `FleetRecord` too, and are then privileged. Observations therefore
cannot leak truth.

Values stand at the places of their rows in `coopenv.scenario.terms`, which `FieldPlace` gives by name, and in their
units; the results kernel scales and clips them.
"""

from enum import IntEnum
from typing import Any

import warp as wp

from coopenv.scenario import terms
from coopenv.scenario.terms import OBSERVATION_FIELDS

LOG10_E = wp.constant(0.4342944819032518)
FORESIGHT = wp.constant(6.0)
"""Time horizon of the closest approach, s."""
FAR = wp.constant(4.0)
"""Upper bound of the closest approach, m; also its value without a message."""
DEGREES = wp.constant(57.29577951308232)
EIGENVALUE_FLOOR = wp.constant(1.0e-9)
NEVER = wp.constant(1.0e9)
"""Age without any measurement or message, s."""
ROLES = wp.constant(terms.ROLES)

mat66 = wp.types.matrix((6, 6), wp.float32)


@wp.struct
class Ego:
    """The vehicle's own estimate, odometry, action and route."""

    number: wp.int32  # of the vehicle in the fleet, from 0
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
    protection_level: wp.vec2  # m and rad, bounds that the observer states; inf: unknown, or none stated
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
    action: wp.vec3  # first entries of this decision, [-1, 1]: of the drive, then the camera's; 0 beyond
    effort: wp.float32  # |action|^2, without the radio's entries
    bytes_sent: wp.int32  # in this decision
    command: wp.vec3  # the action as speed m/s, steering rad or turn rate rad/s, acceleration m/s^2
    steering: wp.float32  # rad, positive to the left; 0 of a drive without steering
    turn_rate: wp.float32  # rad/s, positive to the left; of a drive without steering
    lateral_speed: wp.float32  # m/s, to the left; of an omnidirectional drive
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
class TruthRecord:
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
    scored_time: wp.float32  # s of this decision for which the position error counts in the score
    lost_time: wp.float32  # s for which the vehicle counts as lost after the step that ends its episode; else 0


@wp.struct
class FleetRecord:
    """The vehicles of a world that were under way in this step, the vehicle itself among them; 0 without any."""

    vehicles: wp.int32
    mean_error: wp.float32  # m, of the position
    worst_error: wp.float32  # m
    mean_std: wp.float32  # m, of `Ego.position_std`
    worst_std: wp.float32  # m


@wp.struct
class Target:
    """A landmark or another vehicle as measured by the camera."""

    index: wp.int32  # landmarks first, then vehicles
    bearing: wp.vec3  # unit vector camera to target, body, last measured; 0: never
    in_view: wp.bool  # measured in this frame
    age: wp.float32  # s since measured


@wp.struct
class Neighbour:
    """Another vehicle by its last message (0 without one) and as measured by the camera."""

    index: wp.int32  # of the vehicle
    received: wp.bool  # there is a message and it is not stale
    position: wp.vec3  # m, sender's estimate relative to the vehicle's own, body
    rotation: wp.mat33  # sender's body to the vehicle's own estimated body
    std: wp.float32  # m, standard deviation of its position that it states; inf: no report at hand
    age: wp.float32  # s since it was sent
    bearing: wp.vec3  # unit vector camera to the vehicle, body, last measured; 0: never
    in_view: wp.bool  # measured in this frame
    bearing_age: wp.float32  # s since measured
    precedes: wp.bool  # a message of it is at hand, and it has the right of way
    sees: wp.bool  # by its message at hand, it measured this vehicle in the frame of the sending
    seen_age: wp.float32  # s since it measured this vehicle, by its last message


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


SOURCES: dict[str, int] = {}
"""First place of every built-in field among the values of its kind of record."""
_sizes = dict.fromkeys(("vehicle", "target", "neighbour", "landmark"), 0)
for _name, _row in OBSERVATION_FIELDS.built_in.items():
    SOURCES[_name] = _sizes[_row.per]
    _sizes[_row.per] += _row.size
VehicleValues, TargetValues, NeighbourValues, LandmarkValues = (
    wp.types.vector(size, wp.float32) for size in _sizes.values()
)
FieldPlace: Any = IntEnum("FieldPlace", SOURCES)
"""First place of a built-in field by its name, for kernels."""


@wp.func
def put(values: Any, place: int, vector: Any):
    """Return values with the entries of a vector from a place on."""
    for k in range(len(vector)):
        values[place + k] = vector[k]
    return values


@wp.func
def found(age: wp.float32) -> wp.float32:
    """Return 1 for the age in s of something that was measured in this episode, otherwise 0."""
    return wp.where(age < NEVER, 1.0, 0.0)


@wp.func
def log10(value: wp.float32) -> wp.float32:
    """Return the decimal logarithm."""
    return wp.log(value) * LOG10_E


@wp.func
def closest_on_segment(position: wp.vec2, velocity: wp.vec2, duration: wp.float32) -> wp.float32:
    """Return the closest approach (m) of two points within a duration (s), from their relative motion."""
    time = wp.clamp(-wp.dot(position, velocity) / wp.max(wp.length_sq(velocity), 1.0e-9), 0.0, duration)
    return wp.length(position + time * velocity)


@wp.func
def closest_approach_driving(ahead: wp.vec4, step: wp.float32, speed: wp.float32, position: wp.vec2, forward: wp.vec2):
    """Return the closest approach (m) to a neighbour that drives straight on while the vehicle follows its route.

    Args:
        ahead: directions of the route 1, 2, 4 and 8 steps ahead, rad to the left.
        step: m.
        speed: of both, m/s, above 0.
        position: of the neighbour, m, body frame.
        forward: heading of the neighbour, unit vector, body frame.
    """
    closest, begin, at = FAR, 0.0, wp.vec2()
    for k in range(4):
        if begin < FORESIGHT:
            to = step * wp.vec2(wp.cos(ahead[k]), wp.sin(ahead[k]))
            time = step / speed - begin
            velocity = (to - at) / time
            duration = wp.where(k == 3, FORESIGHT, wp.min(step / speed, FORESIGHT)) - begin
            apart = position + begin * speed * forward - at
            closest = wp.min(closest, closest_on_segment(apart, speed * forward - velocity, duration))
            begin += time
            at = to
            step += step
    return closest


@wp.func
def log10_of_std(std: wp.float32) -> wp.float32:
    """Return the decimal logarithm of a standard deviation, at least a micrometre or a microradian."""
    return log10(wp.max(std, 1.0e-6))


@wp.func
def vehicle_values(ego: Ego) -> VehicleValues:
    """Return the values of the fields with one value per vehicle."""
    R, P, std = ego.rotation_estimate, ego.covariance, ego.axis_std
    values = VehicleValues()
    values = put(values, FieldPlace.estimate_position, ego.position_estimate)
    values = put(values, FieldPlace.estimate_forward, wp.vec3(R[0, 0], R[1, 0], R[2, 0]))
    values = put(values, FieldPlace.estimate_left, wp.vec3(R[0, 1], R[1, 1], R[2, 1]))
    for k in range(6):
        values[FieldPlace.covariance_diagonal + k] = log10(P[k, k])
    values[FieldPlace.log_determinant] = ego.mean_log_variance
    values[FieldPlace.gramian_min_eigenvalue] = log10(wp.max(ego.gramian_min_eigenvalue, EIGENVALUE_FLOOR))
    values[FieldPlace.targets_in_view] = wp.float32(ego.targets_in_view)
    values = put(values, FieldPlace.velocity, ego.velocity)
    values = put(values, FieldPlace.angular_velocity, ego.angular_velocity)
    values[FieldPlace.odometry_age] = ego.odometry_age
    values = put(values, FieldPlace.goal, ego.goal)
    values[FieldPlace.position_std] = log10_of_std(ego.position_std)
    values = put(values, FieldPlace.axis_std, wp.vec3(log10_of_std(std[0]), log10_of_std(std[1]), log10_of_std(std[2])))
    values[FieldPlace.heading_std] = log10_of_std(ego.heading_std)
    values[FieldPlace.soft_observability] = ego.soft_observability
    values[FieldPlace.protection_position] = log10_of_std(ego.protection_level[0])
    values[FieldPlace.protection_angle] = log10_of_std(ego.protection_level[1])
    values[FieldPlace.route_offset] = ego.route_offset
    values[FieldPlace.route_heading] = ego.route_heading
    values[FieldPlace.route_left] = ego.route_left
    values = put(values, FieldPlace.route_ahead, ego.route_ahead)
    values[FieldPlace.steering] = ego.steering
    values[FieldPlace.turn_rate] = ego.turn_rate
    values[FieldPlace.lateral_speed] = ego.lateral_speed
    values = put(values, FieldPlace.last_action, ego.action)
    values[FieldPlace.time_left] = ego.time_left
    values[FieldPlace.camera_pan] = ego.pan
    if ego.number < ROLES:
        values[FieldPlace.role + ego.number] = 1.0
    return values


@wp.func
def target_values(target: Target) -> TargetValues:
    """Return the values of the fields with one value per landmark and vehicle."""
    values = TargetValues()
    values = put(values, FieldPlace.bearing, target.bearing)
    values[FieldPlace.bearing_mask] = wp.float32(target.in_view)
    values[FieldPlace.bearing_age] = target.age
    values[FieldPlace.bearing_found] = found(target.age)
    return values


@wp.func
def neighbour_values(ego: Ego, neighbour: Neighbour, clearance: bool) -> NeighbourValues:
    """Return the values of the fields with one value per other vehicle; those of `message_clearance` on demand."""
    place, R = neighbour.position, neighbour.rotation
    driving, standing = FAR, FAR
    if clearance and neighbour.received:
        position, forward = wp.vec2(place[0], place[1]), wp.vec2(R[0, 0], R[1, 0])
        driving = closest_approach_driving(ego.route_ahead, ego.route_step, ego.top_speed, position, forward)
        standing = wp.min(FAR, closest_on_segment(position, ego.top_speed * forward, FORESIGHT))
    values = NeighbourValues()
    values = put(values, FieldPlace.message_position, place)
    values = put(values, FieldPlace.message_forward, wp.vec3(R[0, 0], R[1, 0], R[2, 0]))
    values[FieldPlace.message_mask] = wp.float32(neighbour.received)
    values[FieldPlace.message_age] = neighbour.age
    values = put(values, FieldPlace.message_clearance, wp.vec2(driving, standing))
    values[FieldPlace.message_precedence] = wp.float32(neighbour.precedes)
    values = put(values, FieldPlace.sighting, neighbour.bearing)
    values[FieldPlace.sighting_mask] = wp.float32(neighbour.in_view)
    values[FieldPlace.sighting_age] = neighbour.bearing_age
    values[FieldPlace.seen_mask] = wp.float32(neighbour.sees)
    values[FieldPlace.seen_age] = neighbour.seen_age
    values[FieldPlace.message_std] = log10_of_std(neighbour.std)
    values[FieldPlace.sighting_found] = found(neighbour.bearing_age)
    values[FieldPlace.seen_found] = found(neighbour.seen_age)
    return values


@wp.func
def landmark_values(landmark: MapLandmark) -> LandmarkValues:
    """Return the values of the fields with one value per landmark of the map."""
    values = LandmarkValues()
    values = put(values, FieldPlace.map_position, landmark.position)
    values[FieldPlace.map_mask] = wp.float32(landmark.exists)
    values[FieldPlace.map_in_view] = wp.float32(landmark.expected)
    values[FieldPlace.map_age] = landmark.age
    values[FieldPlace.map_found] = found(landmark.age)
    return values
