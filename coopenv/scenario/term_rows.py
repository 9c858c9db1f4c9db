"""The rows of coopenv's own terms, as plain data; `coopenv.scenario.terms` makes them."""

from typing import Any

LOG_SCALE = 10.0
"""Decades (or nepers of log det P / 6) that fill the range of a logarithmic entry."""

COLUMNS = ("per", "size", "unit", "scale", "low", "meaning", "planar", "center")
"""Of a field; the last two, which entries a vehicle on a plane needs and what reads 0, only where they are unusual."""
XY = (0, 1)
FIELDS: dict[str, list[tuple[Any, ...]]] = {  # group: name, columns
    "estimate": [
        ("estimate_position", "vehicle", 3, "m", "position_scale", -1, "Rhat phat, map frame", XY),
        ("estimate_forward", "vehicle", 3, "1", 1, -1, "first column of Rhat: the body's x axis in the map", XY),
        ("estimate_left", "vehicle", 3, "1", 1, -1, "second column of Rhat: the body's y axis in the map", ()),
    ],
    "quality": [
        ("covariance_diagonal", "vehicle", 6, "log10", LOG_SCALE, -1, "log10 diag P over (2 lambda, p)", (2, 3, 4)),
        ("log_determinant", "vehicle", 1, "1", LOG_SCALE, -1, "log det P / 6"),
        ("gramian_min_eigenvalue", "vehicle", 1, "log10", LOG_SCALE, -1, "log10, floor 1e-9, sliding window"),
        ("targets_in_view", "vehicle", 1, "targets", "targets", 0, "number of targets measured in this frame"),
    ],
    "bearings": [
        ("bearings", "target", 3, "1", 1, -1, "unit vector camera to target, optical frame; 0: never seen"),
        ("bearing_mask", "target", 1, "bool", 1, 0, "1: measured in this frame"),
        ("bearing_age", "target", 1, "s", "age_scale", 0,
         "time since measured; 1: longer ago than the scale, or never"),
    ],
    "odometry": [
        ("velocity", "vehicle", 3, "m/s", "velocity_scale", -1, "last odometry sample, body frame", (0,)),
        ("angular_velocity", "vehicle", 3, "rad/s", "angular_velocity_scale", -1, "last odometry sample, body frame",
         (2,)),
        ("odometry_age", "vehicle", 1, "s", "age_scale", 0, "age of that sample"),
    ],
    "messages": [
        ("message_position", "neighbour", 3, "m", "position_scale", -1,
         "neighbour's estimate seen from one's own estimate", XY),
        ("message_forward", "neighbour", 3, "1", 1, -1, "neighbour's forward axis in one's own estimated frame", XY),
        ("message_mask", "neighbour", 1, "bool", 1, 0, "1: a message is at hand and not stale"),
        ("message_age", "neighbour", 1, "s", "age_scale", 0, "time since it was sent"),
    ],
    "clearance": [
        ("message_clearance", "neighbour", 2, "m", 2, -1,
         "how near it comes in 6 s if it goes straight on at top speed and oneself goes along the way so, or stands; "
         "4: farther, or unheard", None, 2.0),
    ],
    "goal": [
        ("goal", "vehicle", 3, "m", "position_scale", -1,
         "goal seen from one's own estimate, body frame; 0 without a goal", XY),
    ],
    "uncertainty": [
        ("position_std", "vehicle", 1, "log10 m", 1.5, -1, "log10 of sqrt(trace P_pos)", None, -1.25),
        ("axis_std", "vehicle", 3, "log10 m", 1.5, -1,
         "log10 of the position's standard deviation along the estimated body's axes", XY, -1.25),
        ("heading_std", "vehicle", 1, "log10 rad", 1.5, -1, "log10 of that of the turn about the body's z axis",
         None, -2.0),
        ("soft_observability", "vehicle", 1, "log10", 2.5, -1,
         "log10 of floor + smallest eigenvalue of the sliding Gramian", None, -2.5),
    ],
    "sightings": [
        ("sighting", "neighbour", 3, "1", 1, -1, "unit vector camera to neighbour, body frame; 0: never seen", XY),
        ("sighting_mask", "neighbour", 1, "bool", 1, 0, "1: measured in this frame"),
        ("sighting_age", "neighbour", 1, "s", "age_scale", 0, "time since measured"),
    ],
    "map": [
        ("map_position", "landmark", 3, "m", "map_scale", -1,
         "landmark of the map seen from one's own estimate, body frame", XY),
        ("map_mask", "landmark", 1, "bool", 1, 0, "1: there is such a landmark"),
        ("map_in_view", "landmark", 1, "bool", 1, 0,
         "1: to be seen from one's own estimate: in range, in the image, behind nothing known"),
        ("map_age", "landmark", 1, "s", "age_scale", 0, "time since its bearing was measured"),
    ],
    "route": [
        ("route_offset", "vehicle", 1, "m", 1, -1, "offset to the left of the way, by one's own estimate"),
        ("route_heading", "vehicle", 1, "rad", 1, -1, "estimated heading less that of the way"),
        ("route_left", "vehicle", 1, "m", "position_scale", -1, "way that is left to the goal"),
        ("route_ahead", "vehicle", 4, "rad", 1, -1,
         "direction, from the estimated body's x axis to the left, of the way 1, 2, 4 and 8 `route_step` ahead"),
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
    ("progress", "m", True, "Decrease of the true way to the goal: along the drawn route, else as the crow flies"),
    ("arrival", "1", False, "1 in the step of arrival"),
    ("collision", "1", False, "-1 in the step of a collision"),
    ("off_route", "1", False, "-1 in the step in which the vehicle has left its route"),
    ("control", "1", False, "-|action|^2"),
    ("time", "s", False, "Minus the time that has passed"),
    ("position_error", "m", True, "-|position error|"),
    ("orientation_error", "rad", True, "-orientation error"),
    ("position_uncertainty", "m^2", False,
     "Per metre gained: minus the part of sqrt(trace P_pos) above the threshold, at most the cap"),
    ("position_error_per_metre", "m^2", True, "The same of the true position error"),
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
