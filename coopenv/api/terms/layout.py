"""Meaning of each entry of an observation or action: the published tables, and the spaces built from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from coopenv.base.errors import CoopenvError, check_one_of, listed
from coopenv.motions.table import MOTIONS, columns_of
from coopenv.scenario import Scenario
from coopenv.scenario.dynamics import Dynamics
from coopenv.scenario.terms import GROUPS, OBSERVATION_FIELDS, READINGS, SETTINGS, SETTINGS_OF_ACTIONS, ObservationField

if TYPE_CHECKING:
    from gymnasium import spaces


COLUMNS_OBSERVED = {name for kind in MOTIONS.values() for name, _, _ in kind.columns} - {"speed"}
"""Columns of commands whose present value is a field of the observation, of the same name."""
RADIO = "radio_"
"""Beginning of the names of an action's entries for the radio; a number follows, that of the other vehicle."""


@dataclass(frozen=True)
class Field:
    """One named part of the flat observation; every entry is (value - center) / scale, clipped to [low, 1]."""

    start: int  # its first entry's place in the flat vector
    stop: int  # the place after its last entry
    shape: tuple[int, ...]  # of its values
    group: str  # of `observation.include`
    unit: str  # of its values, center and scale
    scale: float  # divisor of a value, in its unit
    low: float  # -1, or 0 where a value cannot be negative
    meaning: str  # in words
    center: float = 0.0  # subtracted before, in its unit

    @property
    def slice(self) -> slice:
        """The field's place in the flat vector."""
        return slice(self.start, self.stop)

    def values(self, observation: np.ndarray) -> np.ndarray:
        """Return the values in the field's unit, (..., *shape), of flat observations (..., D)."""
        entries = observation[..., self.slice]
        return np.asarray(self.center + self.scale * entries).reshape(*observation.shape[:-1], *self.shape)


@dataclass(frozen=True)
class ActionField:
    """One entry of an action, which spans [low, high] as it goes from -1 to 1."""

    name: str  # of what is commanded
    unit: str  # of low and high
    low: float  # value of -1
    high: float  # value of 1

    def level(self, value: Any) -> Any:
        """Return the entry of an action for values in the unit of the field; beyond [-1, 1] if out of reach."""
        return 2.0 * (value - self.low) / (self.high - self.low) - 1.0


class Layout(dict[str, Field]):
    """The fields of the flat observation by name, in their order, and the fields of the actions."""

    def __init__(self, fields: Mapping[str, Field], actions: tuple[tuple[ActionField, ...], ...]) -> None:
        super().__init__(fields)
        self.actions = actions
        """Per vehicle, whose limits they span; vehicles with the same kind of motion have the same names and units."""

    @property
    def action(self) -> tuple[ActionField, ...]:
        """The fields of the first vehicle's action, and of any other's that has the same drive and limits."""
        return self.actions[0]

    @property
    def size(self) -> int:
        """Length of the flat observation."""
        return max(field.stop for field in self.values())

    @property
    def parts(self) -> dict[str, slice]:
        """Places of the entries of an observation as a dict, which leaves out fields without a value."""
        return {name: field.slice for name, field in self.items() if field.start < field.stop}

    def copy(self) -> Layout:
        """Return another one that may be changed."""
        return Layout(self, self.actions)


def included_fields(scenario: Scenario) -> dict[str, ObservationField]:
    """Return the rows of the fields that a scenario's observation holds: coopenv's, then others as they are listed.

    Raises:
        CoopenvError: one is not known in this process, or none is left.
    """
    wanted, unwanted = scenario.observation.include, scenario.observation.exclude
    known = OBSERVATION_FIELDS.known(scenario.observation.custom)
    if scenario.sensors:
        from coopenv.api.terms.readings import reading_fields  # with Warp, which few descriptions need

        known = {**known, **reading_fields(scenario)}
    by_group: dict[str, dict[str, ObservationField]] = {READINGS: {}}
    for name, row in known.items():
        by_group.setdefault(row.group or name, {})[name] = row
    for name, row in known.items():
        by_group.setdefault(name, {name: row})  # a group of one, unless a group has its name
    for group in (*wanted, *unwanted):
        if group not in by_group:
            raise CoopenvError(f"observation field '{group}' is not registered in this process; see docs/terms.md")
    first = [group for group in GROUPS if group in wanted]
    fields = {name: row for group in (*first, *wanted) for name, row in by_group[group].items()}
    left_out = {name for group in unwanted for name in by_group[group]}
    kept = {name: row for name, row in fields.items() if name not in left_out and entries_of(row, scenario)}
    if not kept:
        raise CoopenvError("observation.exclude: nothing is left of the observation")
    return kept


def entries_of(row: ObservationField, scenario: Scenario) -> tuple[int, ...]:
    """Return the entries of a field's value that a scenario's observation holds."""
    if row is OBSERVATION_FIELDS.built_in["last_action"]:
        return tuple(range(min(row.size, scenario.columns + (scenario.action.pan is not None))))
    if row is OBSERVATION_FIELDS.built_in["role"]:
        return tuple(range(min(row.size, len(scenario.vehicles))))
    if row.scale in COLUMNS_OBSERVED and not _spans(scenario, str(row.scale)):
        return ()
    if scenario.observation.planar and row.planar is not None:
        return row.planar
    return tuple(range(row.size))


def row_counts(scenario: Scenario) -> dict[str, int]:
    """Return the number of an observation's rows of records of each kind, in the order of `Records`."""
    kept, others = scenario.topology.most_nearby, len(scenario.vehicles) - 1
    return {
        "target": kept or len(scenario.target_names),
        "neighbour": min(kept or others, others),
        "landmark": scenario.observation.map_size,
    }


def observation_layout(scenario: Scenario) -> Layout:
    """Return the fields in their order in the flat observation, the same for every vehicle.

    Other vehicles are listed in ascending order without the vehicle itself; targets are all landmarks, then all
    vehicles, the vehicle itself included (always masked); landmarks of the map are those nearest, nearest first. With
    `topology.most_nearby` other vehicles and targets are those that are kept, in ascending order, then empty rows.
    """
    observation, counts = scenario.observation, row_counts(scenario)
    layout, start = {}, 0
    for name, row in included_fields(scenario).items():
        size = len(entries_of(row, scenario))
        each = () if row.size == 1 and row.per != "vehicle" else (size,)
        shape = each if row.per == "vehicle" else (counts[row.per], *each)
        stop = start + int(np.prod(shape))
        scale = observation.scales.get(name) or _scale(row, scenario)
        center = observation.centers.get(name, row.center)
        group, low = row.group or name, float(row.low)
        layout[name] = Field(start, stop, shape, group, row.unit, scale, low, row.meaning, center)
        start = stop
    if start == 0:
        groups = listed(observation.include)
        raise CoopenvError(f"observation.include: {groups} without an entry here; add a group such as 'estimate'")
    every = scenario.limits
    actions = {key: action_fields(scenario, limits) for key, limits in {id(each): each for each in every}.items()}
    return Layout(layout, tuple(actions[id(limits)] for limits in every))


def _scale(row: ObservationField, scenario: Scenario) -> float:
    if row.scale == "targets":
        return float(scenario.topology.most_nearby or len(scenario.target_names))
    if row.scale in COLUMNS_OBSERVED:
        return float(max(_spans(scenario, str(row.scale)), default=1.0))
    if row.scale == "pan":
        return 1.0 if scenario.action.pan is None else scenario.action.pan.limit
    return float(getattr(scenario.observation, row.scale) if isinstance(row.scale, str) else row.scale)


def _spans(scenario: Scenario, name: str) -> list[float]:
    """Return what an entry of 1 asks of a column of commands, for each of the vehicles whose drives have the column."""
    every = {id(limits): limits for limits in scenario.limits}  # vehicles share the sections of the scenario
    columns = (column for limits in every.values() for column in columns_of(limits))
    return [scenario.action.at_one(column) for column in columns if column.name == name]


def action_fields(scenario: Scenario, limits: Dynamics | None = None) -> tuple[ActionField, ...]:
    """Return the meaning of an action's entries: the columns of the vehicle's drive, then pan and radio.

    The first is a speed or acceleration, the second turns the vehicle (positive: left). Where other vehicles' drives
    have more columns, further entries are named `unused`. `limits` are a vehicle's; None: the first one's.
    """
    limits = limits or scenario.limits[0]
    first, *turns = columns_of(limits)
    if scenario.action.longitudinal == "acceleration" and first.name == "speed":
        entries = [ActionField("acceleration", "m/s^2", -limits.max_acceleration, limits.max_acceleration)]
    else:
        entries = [ActionField(first.name, first.unit, first.low, first.high)]
    for column in turns:
        high = scenario.action.at_one(column)
        entries.append(ActionField(column.name, column.unit, max(column.low, -high), high))
    entries += [ActionField("unused", "1", -1.0, 1.0)] * (scenario.columns - len(entries))
    if (pan := scenario.action.pan) is not None:
        entries.append(ActionField("pan", "rad", -pan.limit, pan.limit))
    others = len(scenario.vehicles) - 1 if scenario.action.radio else 0
    return (*entries, *(ActionField(f"{RADIO}{n + 1}", "1", -1.0, 1.0) for n in range(others)))


def settings_of_meaning(scenario: Scenario, fields: Iterable[str]) -> dict[str, float]:
    """Return the settings by dotted key, but those that are not set, that say what entries mean beside the layout.

    They are those of the given fields and of actions. `dynamics` is the first vehicle's, whichever table says it.
    `horizon` is none of them: it is the unit of `time_left`.
    """
    keys = {key for name in fields for key in SETTINGS.get(name, ())} | {*SETTINGS_OF_ACTIONS}
    values = {}
    for key in sorted(keys):
        section, name = key.split(".")
        value = getattr(scenario.limits[0] if section == "dynamics" else getattr(scenario, section), name)
        if value is not None:
            values[key] = float(value)
    return values


def observation_space(layout: Layout, kind: str = "flat") -> spaces.Space[Any]:
    """Return the flat float32 Box, or a one-level Dict of one-dimensional boxes, one per field with values.

    Raises:
        CoopenvError: `kind` is neither "flat" nor "dict".
    """
    from gymnasium import spaces

    check_one_of("unknown observation", kind, ("flat", "dict"))
    if kind == "flat":
        low = np.concatenate([np.full(f.stop - f.start, f.low, dtype=np.float32) for f in layout.values()])
        return spaces.Box(low, np.ones_like(low), dtype=np.float32)
    fields = {name: layout[name] for name in layout.parts}
    return spaces.Dict(
        {name: spaces.Box(f.low, 1.0, shape=(f.stop - f.start,), dtype=np.float32) for name, f in fields.items()}
    )


def action_space(scenario: Scenario) -> spaces.Box:
    """Return the action: what the drive commands, such as speed and steering, pan and radio if any, in [-1, 1]."""
    from gymnasium import spaces

    return spaces.Box(-1.0, 1.0, shape=(scenario.action_size,), dtype=np.float32)
