"""The rows of coopenv's own terms, as plain data; `coopenv.scenario.terms` makes them."""

from typing import Any

LOG_SCALE = 10.0
"""Decades (or nepers of log det P / 6) that fill the range of a logarithmic entry."""

COLUMNS = ("per", "size", "unit", "scale", "low", "meaning", "planar", "center")
"""Of a field; the last two, which entries a vehicle on a plane needs and what reads 0, only where they are unusual."""
XY = (0, 1)
FIELDS: dict[str, list[tuple[Any, ...]]] = {  # group: name, columns
    "estimate": [
        ("estimate_position", "vehicle", 3, "m", "position_scale", -1, "estimated position, map frame", XY),
        ("estimate_forward", "vehicle", 3, "1", 1, -1,
         "estimated direction of the body's x axis (forward), map frame", XY),
        ("estimate_left", "vehicle", 3, "1", 1, -1,
         "estimated direction of the body's y axis (to the left), map frame", ()),
    ],
    "quality": [
        ("covariance_diagonal", "vehicle", 6, "log10", LOG_SCALE, -1,
         "log10 of the diagonal of the observer's P: attitude about x, y, z, then position", (2, 3, 4)),
        ("log_determinant", "vehicle", 1, "1", LOG_SCALE, -1, "log det P / 6, the mean logarithm of P's eigenvalues"),
        ("gramian_min_eigenvalue", "vehicle", 1, "log10", LOG_SCALE, -1,
         "log10 of the smallest eigenvalue of the sliding observability Gramian, at least 1e-9"),
        ("targets_in_view", "vehicle", 1, "targets", "targets", 0, "number of targets measured in this frame"),
    ],
    "bearings": [
        ("bearings", "target", 3, "1", 1, -1, "unit vector camera to target, optical frame; 0: never seen"),
        ("bearing_mask", "target", 1, "bool", 1, 0, "1: measured in this frame"),
        ("bearing_age", "target", 1, "s", "age_scale", 0,
         "time since measured; 1: longer ago than the scale, or never"),
    ],
    "odometry": [
        ("velocity", "vehicle", 3, "m/s", "velocity_scale", -1,
         "velocity of the last odometry sample, body frame", (0,)),
        ("angular_velocity", "vehicle", 3, "rad/s", "angular_velocity_scale", -1,
         "angular velocity of the last odometry sample, body frame", (2,)),
        ("odometry_age", "vehicle", 1, "s", "age_scale", 0, "age of the last odometry sample"),
    ],
    "messages": [
        ("message_position", "neighbour", 3, "m", "position_scale", -1,
         "neighbour's estimate seen from one's own estimate", XY),
        ("message_forward", "neighbour", 3, "1", 1, -1, "neighbour's forward axis in one's own estimated frame", XY),
        ("message_mask", "neighbour", 1, "bool", 1, 0, "1: a message is at hand and not stale"),
        ("message_age", "neighbour", 1, "s", "age_scale", 0, "time since the message was sent"),
    ],
    "clearance": [
        ("message_clearance", "neighbour", 2, "m", 2, -1,
         "least distance within 6 s to the neighbour, if that drives straight on at top speed and this vehicle follows "
         "its route at top speed, or stands; 4: farther, or nothing heard", None, 2.0),
    ],
    "goal": [
        ("goal", "vehicle", 3, "m", "position_scale", -1,
         "goal seen from one's own estimate, body frame; 0 without a goal", XY),
    ],
    "uncertainty": [
        ("position_std", "vehicle", 1, "log10 m", 1.5, -1,
         "log10 of the standard deviation of the position, sqrt(trace P_pos)", None, -1.25),
        ("axis_std", "vehicle", 3, "log10 m", 1.5, -1,
         "log10 of the position's standard deviation along the estimated body's axes", XY, -1.25),
        ("heading_std", "vehicle", 1, "log10 rad", 1.5, -1, "log10 of the standard deviation of the heading",
         None, -2.0),
        ("soft_observability", "vehicle", 1, "log10", 2.5, -1,
         "log10 of (floor + smallest eigenvalue of the sliding observability Gramian)", None, -2.5),
    ],
    "sightings": [
        ("sighting", "neighbour", 3, "1", 1, -1, "unit vector camera to neighbour, body frame; 0: never seen", XY),
        ("sighting_mask", "neighbour", 1, "bool", 1, 0, "1: measured in this frame"),
        ("sighting_age", "neighbour", 1, "s", "age_scale", 0, "time since it was measured"),
    ],
    "map": [
        ("map_position", "landmark", 3, "m", "map_scale", -1,
         "landmark of the map seen from one's own estimate, body frame", XY),
        ("map_mask", "landmark", 1, "bool", 1, 0, "1: there is such a landmark"),
        ("map_in_view", "landmark", 1, "bool", 1, 0,
         "1: visible by one's own estimate: in range, in the image, hidden by nothing known"),
        ("map_age", "landmark", 1, "s", "age_scale", 0, "time since its bearing was measured"),
    ],
    "route": [
        ("route_offset", "vehicle", 1, "m", 1, -1, "offset to the left of the route, by one's own estimate"),
        ("route_heading", "vehicle", 1, "rad", 1, -1, "estimated heading less the direction of the route"),
        ("route_left", "vehicle", 1, "m", "position_scale", -1, "length of the route that is left"),
        ("route_ahead", "vehicle", 4, "rad", 1, -1,
         "direction of the route 1, 2, 4 and 8 times `route_step` ahead, from the estimated body's x axis to the left"),
    ],
    "self": [
        ("steering", "vehicle", 1, "rad", "steering", -1, "steering angle, positive to the left"),
        ("last_action", "vehicle", 3, "1", 1, -1, "action of the last decision; a third entry with `action.pan`"),
        ("time_left", "vehicle", 1, "horizon", 0.5, -1, "share of the horizon that is left", None, 0.5),
    ],
    "pan": [
        ("camera_pan", "vehicle", 1, "rad", "pan", -1, "angle by which the camera is turned, positive to the left"),
    ],
}  # fmt: skip

SETTINGS: dict[str, tuple[str, ...]] = {  # what entries mean also depends on these, beside their scale and center
    "gramian_min_eigenvalue": ("observer.gramian_window", "observer.gramian_distance"),
    "soft_observability": ("observer.gramian_window", "observer.gramian_distance", "reward.observability_floor"),
    "message_clearance": ("observation.route_step", "dynamics.max_speed"),
    "route_ahead": ("observation.route_step",),
}
SETTINGS_OF_ACTIONS = ("rates.decision", "dynamics.max_speed")

REWARDS: list[tuple[str, str, bool, str]] = [  # name, unit, privileged, meaning
    ("progress", "m", True,
     "Decrease of the true distance to the goal: along the drawn route, or else in a straight line"),
    ("arrival", "1", False, "1 in the step of arrival"),
    ("collision", "1", False, "-1 in the step of a collision"),
    ("off_route", "1", False, "-1 in the step in which the vehicle has left its route"),
    ("control", "1", False, "Minus the squared length of the action"),
    ("time", "s", False, "Minus the time that has passed"),
    ("position_error", "m", True, "Minus the position error"),
    ("orientation_error", "rad", True, "Minus the orientation error"),
    ("position_uncertainty", "m^2", False,
     "Per metre gained: minus the part of sqrt(trace P_pos) above the threshold, at most the cap"),
    ("position_error_per_metre", "m^2", True,
     "Per metre gained: minus the part of the true position error above the threshold, at most the cap"),
    ("information_gain", "1", False, "Decrease of log det P / 6: a difference of potentials"),
    ("uncertainty", "1", False, "-log det P / 6: minus the mean log variance"),
    ("observability", "1", False, "log10 of the smallest eigenvalue of the sliding Gramian (floor 1e-9)"),
    ("observability_shortfall", "m", False,
     "Per metre gained: minus what log10(floor + smallest eigenvalue of the sliding Gramian) lacks to the level"),
    ("visibility", "1", False, "Share of its possible targets that the vehicle has in view"),
]  # fmt: skip

CONDITIONS = [  # name, function, meaning
    ("collision", "touches_anything", "Touching a building or another body, at any camera tick"),
    ("off_route", "has_left_route", "Being farther from its route than the given distance, after a decision"),
    ("arrival", "reaches_goal", "Reaching the goal, or passing the end of a drawn route, at any camera tick"),
]
