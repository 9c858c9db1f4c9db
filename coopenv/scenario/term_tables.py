"""The terms of coopenv, one row each; their functions stand in `coopenv/api/terms` under the same names."""

from __future__ import annotations

from coopenv.scenario.terms import ObservationField, Per, Registry, RewardTerm, Scale, TerminationCondition

LOG_SCALE = 10.0
"""Decades (or nepers of log det P / 6) that fill the range of a logarithmic entry."""

_REWARDS: list[tuple[str, str, bool, str]] = [  # name, unit, privileged, meaning
    ("progress", "m", True, "Decrease of the true distance to the goal"),
    ("arrival", "1", False, "1 in the step of arrival"),
    ("collision", "1", False, "-1 in the step of a collision"),
    ("control", "1", False, "-|action|^2"),
    ("time", "s", False, "Minus the time that has passed"),
    ("position_error", "m", True, "-|position error|"),
    ("orientation_error", "rad", True, "-orientation error"),
    ("uncertainty", "1", False, "-log det P / 6: minus the mean log variance"),
    ("observability", "1", False, "log10 of the smallest eigenvalue of the sliding Gramian (floor 1e-9)"),
    ("visibility", "1", False, "Share of its possible targets that the vehicle has in view"),
]

REWARD_TERMS = Registry(
    "reward term",
    {
        name: RewardTerm(
            function=f"coopenv.api.terms.rewards:{name}", unit=unit, privileged=privileged, meaning=meaning
        )
        for name, unit, privileged, meaning in _REWARDS
    },
)

TERMINATION_CONDITIONS = Registry(
    "termination condition",
    {
        "collision": TerminationCondition(
            function="coopenv.world.collision:touches_anything",
            meaning="Touching a building or another body, at any camera tick",
        ),
        "arrival": TerminationCondition(
            function="coopenv.world.collision:reaches_goal", meaning="Reaching the goal, at any camera tick"
        ),
    },
)

_FIELDS: dict[str, list[tuple[str, Per, int, str, float | Scale, int, str]]] = {
    # group: name, per, size, unit, scale, low, meaning
    "estimate": [
        ("estimate_position", "vehicle", 3, "m", "position_scale", -1, "Rhat phat, map frame"),
        ("estimate_forward", "vehicle", 3, "1", 1, -1, "first column of Rhat: the body's x axis in the map"),
        ("estimate_left", "vehicle", 3, "1", 1, -1, "second column of Rhat: the body's y axis in the map"),
    ],
    "quality": [
        ("covariance_diagonal", "vehicle", 6, "log10", LOG_SCALE, -1, "log10 diag P over (2 lambda, p)"),
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
        ("velocity", "vehicle", 3, "m/s", "velocity_scale", -1, "last odometry sample, body frame"),
        ("angular_velocity", "vehicle", 3, "rad/s", "angular_velocity_scale", -1, "last odometry sample, body frame"),
        ("odometry_age", "vehicle", 1, "s", "age_scale", 0, "age of that sample"),
    ],
    "messages": [
        ("message_position", "neighbour", 3, "m", "position_scale", -1,
         "neighbour's estimate seen from one's own estimate"),
        ("message_forward", "neighbour", 3, "1", 1, -1, "neighbour's forward axis in one's own estimated frame"),
        ("message_mask", "neighbour", 1, "bool", 1, 0, "1: a message is at hand and not stale"),
        ("message_age", "neighbour", 1, "s", "age_scale", 0, "time since it was sent"),
    ],
    "goal": [
        ("goal", "vehicle", 3, "m", "position_scale", -1,
         "goal seen from one's own estimate, body frame; 0 without a goal"),
    ],
}  # fmt: skip

GROUPS = tuple(_FIELDS)
"""Groups of fields of coopenv, in their order in an observation."""

OBSERVATION_FIELDS = Registry(
    "observation field",
    {
        name: ObservationField(
            function=f"coopenv.api.terms.observation:{name}",
            group=group,
            per=per,
            size=size,
            unit=unit,
            scale=scale,
            low=0 if low == 0 else -1,
            meaning=meaning,
        )
        for group, rows in _FIELDS.items()
        for name, per, size, unit, scale, low, meaning in rows
    },
)
