"""Fields of the observation about sensors beside the camera: last values, whether they are of this frame, and ages."""

from typing import Any

import warp as wp

from coopenv.api.terms.geometry import seconds_since
from coopenv.scenario import Scenario
from coopenv.scenario.sensors import SensorSection
from coopenv.scenario.terms import READING, READINGS, ObservationField
from coopenv.world.warp_internals import device_function

SCALES = {"m": "position_scale", "m/s": "velocity_scale", "rad/s": "angular_velocity_scale", "rad": 3.2}
"""Scale of values by their unit; of others 1."""
VALUE, MASK, AGE = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.struct
class ReadingEntry:
    """One number of an observation about a sensor, for every target."""

    sensor: wp.int32
    what: wp.int32  # VALUE, MASK or AGE
    number: wp.int32  # of the value
    targets: wp.int32  # how many; 1 of a sensor that measures the map
    place: wp.int32  # in the observation, for the first target
    stride: wp.int32  # between the places for one target and for the next
    center: wp.float32  # the value that reads 0
    factor: wp.float32  # 1 / scale


def _rows(section: SensorSection) -> dict[str, tuple[ObservationField, int, int]]:
    """Return the fields of a sensor, each with what it holds and the number of its first value."""
    kind, name = section.made, f"{READING}{section.label}"
    about: dict[str, Any] = {"group": READINGS, "per": "target" if kind.has_target else "vehicle"}
    about["function"] = f"{__name__}:write_readings"
    rows, first = {}, 0
    for part, size, unit in kind.parts:
        meaning = f"{part or 'value'} by the sensor '{section.label}', last measured; 0: never"
        row = ObservationField(size=size, unit=unit, scale=SCALES.get(unit, 1.0), meaning=meaning, **about)
        rows[f"{name}_{part}" if part else name] = row, int(VALUE), first
        first += size
    mask = ObservationField(unit="bool", low=0, meaning="1: measured in this frame", **about)
    age = ObservationField(unit="s", scale="age_scale", low=0, meaning="time since measured", **about)
    return {**rows, f"{name}_mask": (mask, int(MASK), 0), f"{name}_age": (age, int(AGE), 0)}


def reading_fields(scenario: Scenario) -> dict[str, ObservationField]:
    """Return the rows of the fields about a scenario's sensors, by name."""
    return {name: row for section in scenario.sensors for name, (row, _, _) in _rows(section).items()}


def reading_entries(scenario: Scenario, layout: Any) -> list[tuple[float, ...]]:
    """Return the fields of `ReadingEntry` of every number that a layout holds."""
    entries = []
    for sensor, section in enumerate(scenario.sensors):
        for name, (row, what, first) in _rows(section).items():
            field = layout.get(name)
            targets = len(scenario.target_names) if row.per == "target" else 1
            for k in range(row.size) if field is not None else ():
                place = field.start + k, row.size, field.center, 1.0 / field.scale
                entries.append((sensor, what, first + k, targets, *place))
    return entries


@device_function
def write_readings(
    model: Any,
    state: Any,
    out: wp.array3d(dtype=wp.float32),
    world: int,
    vehicle: int,
    entries: wp.array(dtype=ReadingEntry),
):
    """Write entries, (value - center) / scale, clipped to [-1, 1]."""
    now = state.tick[world]
    for k in range(entries.shape[0]):
        entry = entries[k]
        for target in range(entry.targets):
            then = state.reading_tick[world, vehicle, entry.sensor, target]
            value = wp.where(then == now, 1.0, 0.0)
            if entry.what == VALUE:
                reading = state.reading[world, vehicle, entry.sensor, target]
                value = wp.where(then < 0, 0.0, wp.float32(reading[entry.number]))
            elif entry.what == AGE:
                value = seconds_since(now, then, model.camera_rate)
            scaled = (value - entry.center) * entry.factor
            out[world, vehicle, entry.place + target * entry.stride] = wp.clamp(scaled, -1.0, 1.0)
