"""Which entry of an observation means what: the published slice table, and the spaces built from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from coopenv.scenario import Scenario


@dataclass(frozen=True)
class Field:
    """One named part of the flat observation; every entry is (value / scale), clipped to [low, 1]."""

    start: int
    stop: int
    shape: tuple[int, ...]
    group: str
    unit: str
    scale: float
    low: float
    meaning: str

    @property
    def slice(self) -> slice:
        """The field's place in the flat vector."""
        return slice(self.start, self.stop)


LOG_SCALE = 10.0
"""Decades (or nepers of log det P / 6) that fill the range of a logarithmic entry."""


def observation_layout(scenario: Scenario) -> dict[str, Field]:
    """Return the fields in their order in the flat observation, the same for every vehicle.

    Other vehicles are listed in ascending order without the vehicle itself; targets are all landmarks, then all
    vehicles, the vehicle itself included (always masked).
    """
    A, M = len(scenario.target_names), max(0, len(scenario.vehicles) - 1)
    o = scenario.observation
    metre, speed, turn, age = o.position_scale, o.velocity_scale, o.angular_velocity_scale, o.age_scale
    table: list[tuple[str, str, tuple[int, ...], str, float, float, str]] = [
        ("estimate_position", "estimate", (3,), "m", metre, -1, "Rhat phat, map frame"),
        ("estimate_forward", "estimate", (3,), "1", 1.0, -1, "first column of Rhat: the body's x axis in the map"),
        ("estimate_left", "estimate", (3,), "1", 1.0, -1, "second column of Rhat: the body's y axis in the map"),
        ("covariance_diagonal", "quality", (6,), "log10", LOG_SCALE, -1, "log10 diag P over (2 lambda, p)"),
        ("log_determinant", "quality", (1,), "1", LOG_SCALE, -1, "log det P / 6"),
        ("gramian_min_eigenvalue", "quality", (1,), "log10", LOG_SCALE, -1, "log10, floor 1e-9, sliding window"),
        ("targets_in_view", "quality", (1,), "targets", float(A), 0, "number of targets measured in this frame"),
        ("bearings", "bearings", (A, 3), "1", 1.0, -1, "unit vector camera to target, optical frame; 0: never seen"),
        ("bearing_mask", "bearings", (A,), "bool", 1.0, 0, "1: measured in this frame"),
        ("bearing_age", "bearings", (A,), "s", age, 0, "time since measured; 1: longer ago than the scale, or never"),
        ("velocity", "odometry", (3,), "m/s", speed, -1, "last odometry sample, body frame"),
        ("angular_velocity", "odometry", (3,), "rad/s", turn, -1, "last odometry sample, body frame"),
        ("odometry_age", "odometry", (1,), "s", age, 0, "age of that sample"),
        ("message_position", "messages", (M, 3), "m", metre, -1, "neighbour's estimate seen from one's own estimate"),
        ("message_forward", "messages", (M, 3), "1", 1.0, -1, "neighbour's forward axis in one's own estimated frame"),
        ("message_mask", "messages", (M,), "bool", 1.0, 0, "1: a message is at hand and not stale"),
        ("message_age", "messages", (M,), "s", age, 0, "time since it was sent"),
        ("goal", "goal", (3,), "m", metre, -1, "goal seen from one's own estimate, body frame; 0 without a goal"),
    ]
    layout, start = {}, 0
    for name, group, shape, unit, scale, low, meaning in table:
        if group not in o.include:
            continue
        stop = start + int(np.prod(shape))
        layout[name] = Field(start, stop, shape, group, unit, scale, float(low), meaning)
        start = stop
    return layout


def layout_size(layout: Mapping[str, Field]) -> int:
    """Return the length of the flat observation."""
    return max(field.stop for field in layout.values())


def flat_space(layout: Mapping[str, Field]) -> spaces.Box:
    """Return the flat float32 Box."""
    low = np.concatenate([np.full(f.stop - f.start, f.low, dtype=np.float32) for f in layout.values()])
    return spaces.Box(low, np.ones_like(low), dtype=np.float32)


def dict_space(layout: Mapping[str, Field]) -> spaces.Dict:
    """Return a one-level Dict of one-dimensional boxes, one per field."""
    return spaces.Dict(
        {name: spaces.Box(f.low, 1.0, shape=(f.stop - f.start,), dtype=np.float32) for name, f in layout.items()}
    )


def action_space() -> spaces.Box:
    """Return the action: (speed or acceleration, steering; positive turns left), each in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
