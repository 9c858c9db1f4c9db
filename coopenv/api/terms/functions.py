"""The fields of coopenv's observation and the terms of its reward, one function for every row of their tables.

They return the value in the row's unit; scaling and clipping, or weights, follow. Those that are given `truth` are
privileged. Records: see `coopenv.api.terms.records`.
"""

import warp as wp

from coopenv.api.step_results import DEGREES
from coopenv.api.terms.conflict import FAR, nearest_going, nearest_waiting
from coopenv.api.terms.map_view import MapLandmark
from coopenv.api.terms.records import Ego, Neighbour, Target, Truth, log10
from coopenv.world.collision import COLLIDED, OFF_ROUTE

EIGENVALUE_FLOOR = wp.constant(1.0e-9)


@wp.func
def log10_of_std(std: wp.float32) -> wp.float32:
    """Return the decimal logarithm of a standard deviation, at least a micrometre or a microradian."""
    return log10(wp.max(std, 1.0e-6))


@wp.func
def estimate_position(ego: Ego):
    return ego.position_estimate


@wp.func
def estimate_forward(ego: Ego):
    R = ego.rotation_estimate
    return wp.vec3(R[0, 0], R[1, 0], R[2, 0])


@wp.func
def estimate_left(ego: Ego):
    R = ego.rotation_estimate
    return wp.vec3(R[0, 1], R[1, 1], R[2, 1])


@wp.func
def covariance_diagonal(ego: Ego):
    result = wp.vector(length=6, dtype=wp.float32)
    for i in range(6):
        result[i] = log10(ego.covariance[i, i])
    return result


@wp.func
def log_determinant(ego: Ego):
    return ego.mean_log_variance


@wp.func
def gramian_min_eigenvalue(ego: Ego):
    return log10(wp.max(ego.gramian_min_eigenvalue, EIGENVALUE_FLOOR))


@wp.func
def targets_in_view(ego: Ego):
    return ego.targets_in_view


@wp.func
def bearings(ego: Ego, target: Target):
    return target.bearing


@wp.func
def bearing_mask(ego: Ego, target: Target):
    return target.in_view


@wp.func
def bearing_age(ego: Ego, target: Target):
    return target.age


@wp.func
def velocity(ego: Ego):
    return ego.velocity


@wp.func
def angular_velocity(ego: Ego):
    return ego.angular_velocity


@wp.func
def odometry_age(ego: Ego):
    return ego.odometry_age


@wp.func
def message_position(ego: Ego, neighbour: Neighbour):
    return neighbour.position


@wp.func
def message_forward(ego: Ego, neighbour: Neighbour):
    R = neighbour.rotation
    return wp.vec3(R[0, 0], R[1, 0], R[2, 0])


@wp.func
def message_mask(ego: Ego, neighbour: Neighbour):
    return neighbour.heard


@wp.func
def message_age(ego: Ego, neighbour: Neighbour):
    return neighbour.age


@wp.func
def message_clearance(ego: Ego, neighbour: Neighbour):
    result = wp.vec2(FAR, FAR)
    if neighbour.heard:
        place, R = wp.vec2(neighbour.position[0], neighbour.position[1]), neighbour.rotation
        forward = wp.vec2(R[0, 0], R[1, 0])
        result[0] = nearest_going(ego.route_ahead, ego.route_step, ego.top_speed, place, forward)
        result[1] = nearest_waiting(ego.top_speed, place, forward)
    return result


@wp.func
def goal(ego: Ego):
    return ego.goal


@wp.func
def position_std(ego: Ego):
    return log10_of_std(ego.position_std)


@wp.func
def axis_std(ego: Ego):
    std = ego.axis_std
    return wp.vec3(log10_of_std(std[0]), log10_of_std(std[1]), log10_of_std(std[2]))


@wp.func
def heading_std(ego: Ego):
    return log10_of_std(ego.heading_std)


@wp.func
def sighting(ego: Ego, neighbour: Neighbour):
    return neighbour.bearing


@wp.func
def sighting_mask(ego: Ego, neighbour: Neighbour):
    return neighbour.in_view


@wp.func
def sighting_age(ego: Ego, neighbour: Neighbour):
    return neighbour.bearing_age


@wp.func
def map_position(ego: Ego, landmark: MapLandmark):
    return landmark.position


@wp.func
def map_mask(ego: Ego, landmark: MapLandmark):
    return landmark.exists


@wp.func
def map_in_view(ego: Ego, landmark: MapLandmark):
    return landmark.expected


@wp.func
def map_age(ego: Ego, landmark: MapLandmark):
    return landmark.age


@wp.func
def route_offset(ego: Ego):
    return ego.route_offset


@wp.func
def route_heading(ego: Ego):
    return ego.route_heading


@wp.func
def route_left(ego: Ego):
    return ego.route_left


@wp.func
def route_ahead(ego: Ego):
    return ego.route_ahead


@wp.func
def steering(ego: Ego):
    return ego.steering


@wp.func
def camera_pan(ego: Ego):
    return ego.pan


@wp.func
def last_action(ego: Ego):
    return ego.action


@wp.func
def time_left(ego: Ego):
    return ego.time_left


@wp.func
def progress(ego: Ego, truth: Truth):
    return truth.progress


@wp.func
def arrival(ego: Ego):
    return wp.float32(ego.arrived)


@wp.func
def collision(ego: Ego):
    return wp.where(ego.outcome == COLLIDED, -1.0, 0.0)


@wp.func
def off_route(ego: Ego):
    return wp.where(ego.outcome == OFF_ROUTE, -1.0, 0.0)


@wp.func
def control(ego: Ego):
    return -ego.effort


@wp.func
def time(ego: Ego):
    return -ego.elapsed


@wp.func
def position_error(ego: Ego, truth: Truth):
    return -truth.position_error


@wp.func
def orientation_error(ego: Ego, truth: Truth):
    return -(truth.orientation_error / DEGREES)


@wp.func
def uncertainty(ego: Ego):
    return -ego.log_determinant / 6.0


observability = gramian_min_eigenvalue


@wp.func
def per_metre(ego: Ego, excess: wp.float32, most: wp.float32):
    """Return minus an excess in [0, most] for every metre gained, and `most` for every metre that is missed."""
    paid = wp.where(excess < most, wp.max(excess, 0.0), most)  # what is no number is the most
    return -(paid * ego.metres_gained + most * ego.metres_missed)


@wp.func
def position_uncertainty(ego: Ego):
    return per_metre(ego, ego.position_std - ego.uncertainty_threshold, ego.uncertainty_cap)


@wp.func
def position_error_per_metre(ego: Ego, truth: Truth):
    return per_metre(ego, truth.position_error - ego.uncertainty_threshold, ego.uncertainty_cap)


@wp.func
def soft_observability(ego: Ego):
    return ego.soft_observability


@wp.func
def observability_shortfall(ego: Ego):
    most = wp.max(ego.observability_level - ego.observability_floor, 0.0)
    return per_metre(ego, ego.observability_level - ego.soft_observability, most)


@wp.func
def information_gain(ego: Ego):
    return ego.information_gained


@wp.func
def visibility(ego: Ego):
    return wp.float32(ego.targets_in_view) / wp.float32(wp.max(ego.possible_targets, 1))
