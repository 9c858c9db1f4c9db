"""Values of the built-in observation fields and reward terms, in the order of their rows.

The rows stand in `coopenv.scenario.terms`. A value has the unit of its row; the results kernel scales and clips it,
or weighs it.
"""

import warp as wp

from coopenv.api.terms.geometry import FAR, closest_approach_driving, closest_approach_standing
from coopenv.api.terms.records import Ego, MapLandmark, Neighbour, Target, Truth, log10
from coopenv.scenario.terms import OBSERVATION_FIELDS, REWARD_TERMS
from coopenv.world.dynamics import COLLIDED, OFF_ROUTE

DEGREES = wp.constant(57.29577951308232)
EIGENVALUE_FLOOR = wp.constant(1.0e-9)

SOURCES: dict[str, int] = {}
"""First place of every built-in field among the values of its kind of record."""
_sizes = dict.fromkeys(("vehicle", "target", "neighbour", "landmark"), 0)
for _name, _row in OBSERVATION_FIELDS.built_in.items():
    SOURCES[_name] = _sizes[_row.per]
    _sizes[_row.per] += _row.size
VehicleValues, TargetValues, NeighbourValues, LandmarkValues = (
    wp.types.vector(size, wp.float32) for size in _sizes.values()
)
RewardValues = wp.types.vector(len(REWARD_TERMS.built_in), wp.float32)


@wp.func
def log10_of_std(std: wp.float32) -> wp.float32:
    """Return the decimal logarithm of a standard deviation, at least a micrometre or a microradian."""
    return log10(wp.max(std, 1.0e-6))


@wp.func
def vehicle_values(ego: Ego) -> VehicleValues:
    """Return the values of the fields with one value per vehicle."""
    place, R, P = ego.position_estimate, ego.rotation_estimate, ego.covariance
    velocity, turn_rate, goal = ego.velocity, ego.angular_velocity, ego.goal
    std, ahead, action = ego.axis_std, ego.route_ahead, ego.action
    return VehicleValues(
        place[0], place[1], place[2],  # estimate_position
        R[0, 0], R[1, 0], R[2, 0],  # estimate_forward
        R[0, 1], R[1, 1], R[2, 1],  # estimate_left
        log10(P[0, 0]), log10(P[1, 1]), log10(P[2, 2]),  # covariance_diagonal
        log10(P[3, 3]), log10(P[4, 4]), log10(P[5, 5]),
        ego.mean_log_variance,  # log_determinant
        log10(wp.max(ego.gramian_min_eigenvalue, EIGENVALUE_FLOOR)),  # gramian_min_eigenvalue
        wp.float32(ego.targets_in_view),
        velocity[0], velocity[1], velocity[2],
        turn_rate[0], turn_rate[1], turn_rate[2],  # angular_velocity
        ego.odometry_age,
        goal[0], goal[1], goal[2],
        log10_of_std(ego.position_std),  # position_std
        log10_of_std(std[0]), log10_of_std(std[1]), log10_of_std(std[2]),  # axis_std
        log10_of_std(ego.heading_std),  # heading_std
        ego.soft_observability,
        ego.route_offset, ego.route_heading, ego.route_left,
        ahead[0], ahead[1], ahead[2], ahead[3],  # route_ahead
        ego.steering,
        action[0], action[1], action[2],  # last_action
        ego.time_left,
        ego.pan,  # camera_pan
    )  # fmt: skip


@wp.func
def target_values(target: Target) -> TargetValues:
    """Return the values of the fields with one value per landmark and vehicle."""
    bearing = target.bearing
    return TargetValues(
        bearing[0], bearing[1], bearing[2],  # bearings
        wp.float32(target.in_view),  # bearing_mask
        target.age,  # bearing_age
    )  # fmt: skip


@wp.func
def neighbour_values(ego: Ego, neighbour: Neighbour, clearance: bool) -> NeighbourValues:
    """Return the values of the fields with one value per other vehicle; those of `message_clearance` on demand."""
    place, R, sighting = neighbour.position, neighbour.rotation, neighbour.bearing
    driving, standing = FAR, FAR
    if clearance and neighbour.received:
        position, forward = wp.vec2(place[0], place[1]), wp.vec2(R[0, 0], R[1, 0])
        driving = closest_approach_driving(ego.route_ahead, ego.route_step, ego.top_speed, position, forward)
        standing = closest_approach_standing(ego.top_speed, position, forward)
    return NeighbourValues(
        place[0], place[1], place[2],  # message_position
        R[0, 0], R[1, 0], R[2, 0],  # message_forward
        wp.float32(neighbour.received),  # message_mask
        neighbour.age,  # message_age
        driving, standing,  # message_clearance
        sighting[0], sighting[1], sighting[2],
        wp.float32(neighbour.in_view),  # sighting_mask
        neighbour.bearing_age,  # sighting_age
    )  # fmt: skip


@wp.func
def landmark_values(landmark: MapLandmark) -> LandmarkValues:
    """Return the values of the fields with one value per landmark of the map."""
    place = landmark.position
    return LandmarkValues(
        place[0], place[1], place[2],  # map_position
        wp.float32(landmark.exists),  # map_mask
        wp.float32(landmark.expected),  # map_in_view
        landmark.age,  # map_age
    )  # fmt: skip


@wp.func
def per_metre(ego: Ego, excess: wp.float32, most: wp.float32):
    """Return minus an excess in [0, most] for every metre gained, and `most` for every metre that is missed."""
    paid = wp.where(excess < most, wp.max(excess, 0.0), most)  # NaN costs the most
    return -(paid * ego.metres_gained + most * ego.metres_missed)


@wp.func
def reward_values(ego: Ego, truth: Truth) -> RewardValues:
    """Return the values of the reward terms, without weights."""
    threshold, cap = ego.uncertainty_threshold, ego.uncertainty_cap
    shortfall = ego.observability_level - ego.soft_observability
    largest_shortfall = wp.max(ego.observability_level - ego.observability_floor, 0.0)
    return RewardValues(
        truth.progress,
        wp.float32(ego.arrived),  # arrival
        wp.where(ego.outcome == COLLIDED, -1.0, 0.0),  # collision
        wp.where(ego.outcome == OFF_ROUTE, -1.0, 0.0),  # off_route
        -ego.effort,  # control
        -ego.elapsed,  # time
        -truth.position_error,
        -(truth.orientation_error / DEGREES),
        per_metre(ego, ego.position_std - threshold, cap),  # position_uncertainty
        per_metre(ego, truth.position_error - threshold, cap),  # position_error_per_metre
        ego.information_gained,  # information_gain
        -ego.log_determinant / 6.0,  # uncertainty
        log10(wp.max(ego.gramian_min_eigenvalue, EIGENVALUE_FLOOR)),  # observability
        per_metre(ego, shortfall, largest_shortfall),  # observability_shortfall
        wp.float32(ego.targets_in_view) / wp.float32(wp.max(ego.possible_targets, 1)),  # visibility
    )
