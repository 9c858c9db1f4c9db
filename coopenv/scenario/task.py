"""The task of a policy: observation, action, reward and termination."""

import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, create_model, model_validator

from coopenv.base import units
from coopenv.base.errors import listed, suggest
from coopenv.base.sections import NonNegative, Number, Positive, Section
from coopenv.motions.own import CommandColumn
from coopenv.scenario.terms import (
    GROUPS,
    OBSERVATION_FIELDS,
    READING,
    REWARD_TERMS,
    TERMINATION_CONDITIONS,
    USUAL_GROUPS,
    ObservationField,
    Term,
    check_known,
    check_privilege,
)


def _list_groups(schema: dict[str, Any]) -> None:
    """List the groups of coopenv for editors."""
    schema["items"] = {"anyOf": [{"enum": list(GROUPS)}, {"type": "string"}]}


class Observation(Section):
    """Contents and scales of the observation; every entry is (value - center) / scale, clipped to [-1, 1]."""

    include: tuple[str, ...] = Field(default=USUAL_GROUPS, min_length=1, json_schema_extra=_list_groups)
    """Groups of coopenv's fields, and names of single fields: coopenv's, registered and custom ones."""
    exclude: tuple[str, ...] = Field(default=(), json_schema_extra=_list_groups)
    """Groups and fields that are removed again, for an ablation."""
    planar: bool = False
    """Omit heights, roll and pitch, which a vehicle on a plane cannot change."""
    position_scale: Annotated[Positive, units.PLACE] = 50.0
    """m, of positions and distances"""
    velocity_scale: Annotated[Positive, units.SPEED] = 5.0
    """m/s, of measured velocities"""
    angular_velocity_scale: Annotated[Positive, units.TURN_RATE] = 3.0
    """rad/s, of measured angular velocities"""
    age_scale: Annotated[Positive, units.LAG] = 1.0
    """s; older measurements read 1"""
    map_scale: Annotated[Positive, units.DISTANCE] = 10.0
    """m, of landmarks of the map"""
    map_size: int = Field(default=8, ge=1, le=256)
    """Number of map landmarks in the fields per landmark: the nearest to the vehicle's own estimate."""
    route_step: Annotated[Positive, units.EXTENT] = 0.5
    """m; `route_ahead` shows the way so far ahead, and twice, four and eight times as far"""
    scales: dict[str, Positive] = Field(default={})
    """Scales of single fields by name, in place of their own."""
    centers: dict[str, Number] = Field(default={})
    """Values of single fields, by name, that read 0, in place of their own."""
    custom: dict[Annotated[str, AfterValidator(OBSERVATION_FIELDS.free)], ObservationField] = Field(default={})
    """Fields of one's own by name: where their functions stand, see docs/terms.md."""

    @model_validator(mode="after")
    def _fields_exist(self) -> Self:
        fields = OBSERVATION_FIELDS.known(self.custom)
        groups = {*fields, *GROUPS, *(row.group for row in fields.values() if row.group)}
        for key, names, allowed in (
            ("include: unknown group or field", self.include, groups),
            ("exclude: unknown group or field", self.exclude, groups),
            ("scales: unknown field", self.scales, {*fields}),
            ("centers: unknown field", self.centers, {*fields}),
        ):
            for name in names:
                if name not in allowed and not name.startswith(READING):
                    near = suggest(name, allowed) or f"; known: {listed(sorted(allowed))}"
                    raise ValueError(f"{key} '{name}'{near}")
        return self


class Pan(Section):
    """A camera that turns about its own centre and the body's z axis; the vehicle knows the angle."""

    limit: Annotated[float, Field(gt=0.0, le=math.pi), units.TURN]
    """Largest angle to either side, rad; an entry of 1 asks for it (positive turns left)."""
    rate: Annotated[Positive, units.TURN_RATE]
    """Largest angular rate, rad/s."""


class Action(Section):
    """Meaning of the entries of an action in [-1, 1]: columns of the drive, two or more, then the camera's angle."""

    longitudinal: Literal["speed", "acceleration"] = "speed"
    """`speed`: -1..1 spans the permitted speeds (0 or -max .. max); `acceleration`: times max_acceleration."""
    steering: Annotated[Positive | None, units.TURN] = None
    """Steering angle at action 1, rad (none: max_steering), of vehicles that steer."""
    turn_rate: Annotated[Positive | None, units.TURN_RATE] = None
    """Turn rate at action 1, rad/s (none: max_turn_rate), of vehicles with another drive."""
    pan: Pan | None = None
    """None: cameras do not turn."""
    radio: bool = False
    """Add an entry per other vehicle, in ascending order, for the message to it until the next decision: up to 0 none,
    up to 0.5 the pose alone, for its driver, above 0.5 the whole report, for its estimator, too. Otherwise reports are
    broadcast."""

    def at_one(self, column: CommandColumn) -> float:
        """Return what an entry of 1 asks of a column of the command, in the column's unit."""
        narrowed: float | None = getattr(self, column.name, None) if column.name in type(self).model_fields else None
        return column.high if narrowed is None else narrowed


_built_in: dict[str, Any] = {
    name: (Number, Field(0.0, description=row.described)) for name, row in REWARD_TERMS.built_in.items()
}


class RewardWeights(create_model("_BuiltInWeights", __base__=Section, **_built_in)):  # type: ignore[misc]
    """Weights of the named terms of the reward, per decision step; the reward is their weighted sum.

    One number per name: coopenv's, and any that is registered or stands in `reward.custom`.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Number] = Field(init=False)


def _only_those_of_coopenv(names: Iterable[str], table: str = "") -> Any:
    """Return the rule, for editors, that a table has these keys only where there is no table `custom` beside it."""
    keys: dict[str, Any] = {"propertyNames": {"enum": list(names)}}
    return {"if": {"not": {"required": ["custom"]}}, "then": {"properties": {table: keys}} if table else keys}


class Reward(Section):
    """The reward of one decision step."""

    model_config = ConfigDict(json_schema_extra=_only_those_of_coopenv(REWARD_TERMS.built_in, "weights"))

    weights: RewardWeights = RewardWeights()
    team: Literal["own", "mean", "min"] = "own"
    """Reward of a driven vehicle: its own weighted sum, or the mean or the least of all driven vehicles. With `mean`
    and `min`, an episode continues, without actions, until it is over for all of them; the mean is over all present
    vehicles, the least over the vehicles under way."""
    own_share: units.Chance = 0.0
    """Share of a vehicle's own weighted sum in its reward with a team; the rest is the team's."""
    uncertainty_threshold: Annotated[NonNegative, units.LENGTH] = 0.02
    """Threshold, m; terms per metre count the excess"""
    uncertainty_cap: Annotated[Positive, units.EXTENT] = 1.0
    """Largest counted excess, m; also the price of a metre that is never driven"""
    observability_floor: Positive = 1e-5
    """Addition to the smallest eigenvalue of the sliding Gramian before the logarithm: above the rounding of 0"""
    observability_level: Number = -1.0
    """log10 of the desired smallest eigenvalue"""
    custom: dict[Annotated[str, AfterValidator(REWARD_TERMS.free)], Term] = Field(default={})
    """Terms of one's own by name: where their functions stand, see docs/terms.md."""
    privileged: bool = False
    """Must be true when a weighted term uses the truth."""

    @property
    def by_name(self) -> dict[str, float]:
        """The weight of every computed term: built-in, custom and weighed terms, in this order."""
        named: dict[str, float] = self.weights.model_dump()
        return {**dict.fromkeys((*REWARD_TERMS.built_in, *self.custom), 0.0), **named}

    @model_validator(mode="after")
    def _terms_exist(self) -> Self:
        weights = self.weights.model_dump()
        check_known(REWARD_TERMS, weights, self.custom, "weights.")
        check_privilege(REWARD_TERMS, weights, self)
        return self


class Termination(Section):
    """Conditions that end an agent's episode before the horizon: a switch for each, its own and built-in ones."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra=_only_those_of_coopenv([*TERMINATION_CONDITIONS.built_in, "after_arrival", "privileged"]),
    )
    __pydantic_extra__: dict[str, bool] = Field(init=False)

    collision: bool = True
    """Touching a building or another body ends the vehicle's episode."""
    arrival: bool = True
    """Reaching its goal ends the vehicle's episode."""
    off_route: Annotated[Positive | None, units.EXTENT] = None
    """A vehicle that is so far beside its route, or beyond an end of it, has left the road, and its episode ends, m."""
    after_arrival: Literal["park", "leave", "continue", "transit"] = "park"
    """`park`: a vehicle that has arrived stands where it is; `leave`: it is gone from the next camera tick on;
    `continue`: it draws a new route that starts where the old one ends, and its episode goes on to the horizon;
    `transit`: likewise, and it leaves at the end of a route that none follows."""
    custom: dict[Annotated[str, AfterValidator(TERMINATION_CONDITIONS.free)], Term] = Field(default={})
    """Conditions of one's own by name: where their functions stand, see docs/terms.md."""
    privileged: bool = False
    """Must be true when a condition of one's own that is switched on uses the truth."""

    @property
    def own(self) -> tuple[str, ...]:
        """The conditions that are switched on and not coopenv's."""
        return tuple(name for name, on in self.__pydantic_extra__.items() if on)

    @model_validator(mode="before")
    @classmethod
    def _conditions_exist(cls, given: Any) -> Any:
        if isinstance(given, dict):
            custom = given.get("custom")
            names = [name for name in given if name not in cls.model_fields]
            others = {**cls.model_fields, **(custom if isinstance(custom, dict) else {})}
            check_known(TERMINATION_CONDITIONS, names, others)
        return given

    @model_validator(mode="after")
    def _privilege_is_declared(self) -> Self:
        check_privilege(TERMINATION_CONDITIONS, self.__pydantic_extra__, self)
        return self
