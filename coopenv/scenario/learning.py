"""What a policy sees, does and is rewarded for."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coopenv.scenario.base import NonNegative, Number, Part, Positive

ObservationGroup = Literal["estimate", "quality", "bearings", "odometry", "messages", "goal"]
OBSERVATION_GROUPS: tuple[ObservationGroup, ...] = (
    "estimate",
    "quality",
    "bearings",
    "odometry",
    "messages",
    "goal",
)


class Observation(Part):
    """Contents and scales of the observation; every entry is divided by its scale and clipped to [-1, 1]."""

    include: tuple[ObservationGroup, ...] = Field(default=OBSERVATION_GROUPS, min_length=1)
    position_scale: Positive = 50.0
    """m"""
    velocity_scale: Positive = 5.0
    """m/s"""
    angular_velocity_scale: Positive = 3.0
    """rad/s"""
    age_scale: Positive = 1.0
    """s; older measurements read 1"""


class Dynamics(Part):
    """Kinematic bicycle with its actuators; the defaults are a SVEA car's."""

    wheelbase: Positive = 0.324
    """m"""
    max_speed: Positive = 1.53
    """m/s"""
    reverse: bool = False
    """Whether negative speeds are possible."""
    max_acceleration: Positive = 2.0
    """m/s^2"""
    max_steering: float = Field(default=0.6981317007977318, gt=0.0, lt=1.5)
    """rad (40 deg)"""
    max_steering_rate: Positive = 2.0
    """rad/s"""
    speed_time_constant: NonNegative = 0.1
    """First-order lag of the drive, s."""
    steering_time_constant: NonNegative = 0.05
    """First-order lag of the steering, s."""
    latency: NonNegative = 0.0
    """Dead time between a decision and its effect, s; at most one decision period."""


class Action(Part):
    """Meaning of the two entries of an action in [-1, 1]."""

    longitudinal: Literal["speed", "acceleration"] = "speed"
    """`speed`: -1..1 spans the permitted speeds (0 or -max .. max); `acceleration`: times max_acceleration."""
    steering: Positive | None = None
    """Steering angle at action 1, rad (none: max_steering)."""


class RewardWeights(Part):
    """Weights of the named terms of the reward, per decision step; the reward is their weighted sum."""

    progress: Number = 0.0
    """Decrease of the true distance to the goal, m (privileged)."""
    arrival: Number = 0.0
    """1 in the step of arrival."""
    collision: Number = 0.0
    """-1 in the step of a collision."""
    control: Number = 0.0
    """-|action|^2"""
    time: Number = 0.0
    """-1 per second"""
    position_error: Number = 0.0
    """-|position error|, m (privileged)."""
    orientation_error: Number = 0.0
    """-orientation error, rad (privileged)."""
    uncertainty: Number = 0.0
    """-log det P / 6: minus the mean log variance."""
    observability: Number = 0.0
    """log10 of the smallest eigenvalue of the sliding Gramian (floor 1e-9)."""
    visibility: Number = 0.0
    """Share of its possible targets that the vehicle has in view."""


PRIVILEGED_TERMS = ("progress", "position_error", "orientation_error")
"""Terms that use truth beyond collision and arrival: they exist in simulation only."""


class Reward(Part):
    """The reward of one decision step."""

    weights: RewardWeights = RewardWeights()
    privileged: bool = False
    """Must be true when a weighted term uses the truth."""

    @model_validator(mode="after")
    def _privilege_is_declared(self) -> Reward:
        used = [name for name in PRIVILEGED_TERMS if getattr(self.weights, name) != 0.0]
        if used and not self.privileged:
            raise ValueError(f"privileged: must be true, because the weighted term '{used[0]}' uses the truth")
        return self


class Termination(Part):
    """What ends an agent's episode before the horizon."""

    collision: bool = True
    """Touching a building or another body ends the vehicle's episode."""
    arrival: bool = True
    """Reaching its goal ends the vehicle's episode."""
