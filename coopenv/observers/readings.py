"""Arrays of what sensors beside the camera have measured, by the sensor's name: their shapes, and checks."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.base.sections import LARGEST
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import are_numbers, are_rotations
from coopenv.measurements.sensor import MAP
from coopenv.observers.contract import Setup


def shapes_of_readings(setups: Sequence[Setup]) -> dict[str, tuple[int, int, int]]:
    """Return the shapes (N, T, size), or (N, 1, size) of a sensor that measures the map, by name."""
    kinds = {sensor.name: sensor.kind for setup in setups for sensor in setup.sensors}
    targets = len(setups[0].target_names)
    return {name: (len(setups), targets if kind.has_target else 1, kind.size) for name, kind in kinds.items()}


def nothing_measured(setups: Sequence[Setup]) -> dict[str, Array]:
    """Return the arrays of a tick at which no sensor beside the camera has measured anything."""
    return {name: np.full(shape, np.nan) for name, shape in shapes_of_readings(setups).items()}


def problems_of_sensors(setup: Setup, first: Setup) -> Iterator[str]:
    """Yield the errors of a vehicle's sensors beside the camera; `first` is the setup of the first vehicle."""
    names, kinds = [sensor.name for sensor in setup.sensors], {s.name: s.reference for s in first.sensors}
    for sensor in setup.sensors:
        place = shown(sensor.name)
        if not sensor.name.isidentifier():
            yield f"{place}: is no name"
        if names.count(sensor.name) > 1 or kinds.get(sensor.name, sensor.reference) != sensor.reference:
            yield f"{place}: the name is used twice, or for several kinds"
        try:
            rows, has_target = sensor.kind.rows, sensor.kind.has_target
        except CoopenvError as error:
            yield f"{place}: {error}"
            continue
        for name, shape in (("std", (rows,)), ("position", (3,)), ("rotation", (3, 3))):
            array = getattr(sensor, name)
            if np.shape(array) != shape or array.dtype.kind != "f" or not are_numbers(array).all():
                yield f"{place}.{name}: not an array of shape {shape}"
        targets = set(sensor.targets.tolist())
        if not (targets <= set(setup.targets.tolist()) if has_target else targets == {MAP}):
            yield f"{place}.targets: not among the targets of {setup.name}, or not the map"
        if not (np.asarray(sensor.std) > 0.0).all():
            yield f"{place}.std: not positive"
        if not are_rotations(np.asarray(sensor.rotation)).all():
            yield f"{place}.rotation: not a rotation"


def problems_of_readings(
    readings: Mapping[str, Any], setups: Sequence[Setup], *ticks: int, ignored: NDArray[np.bool_] | None = None
) -> Iterator[str]:
    """Yield the errors of arrays with an unknown name, another shape, or numbers that are no measurement.

    Args:
        readings: arrays (N, T, size) by name, (K, ...) of several ticks.
        setups: of the vehicles.
        ticks: K, if there are several.
        ignored: (N,) vehicles whose rows are not read.
    """
    shapes = shapes_of_readings(setups)
    for name in readings.keys() - shapes.keys():
        yield f"readings: no vehicle has a sensor '{name:.40}'; known: {listed([*shapes]) or 'none'}"
    for name in [name for name in shapes if name in readings]:
        value, shape = readings[name], (*ticks, *shapes[name])
        if not (isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind in "fiu"):
            got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            yield f"readings.{name}: expected numbers of shape {shape}, got {got}"
            continue
        numbers = (np.abs(value) <= LARGEST).all(axis=-1)
        skipped = np.False_ if ignored is None else ignored[:, None]
        valid = np.asarray(numbers | np.isnan(value).all(axis=-1) | skipped)
        if not valid.all():
            *k, i, _ = np.argwhere(~valid)[0].tolist()
            when = f", tick {k[0]}" if k else ""
            expected = f"finite numbers of at most {LARGEST:g}, or NaN where nothing is measured"
            yield f"readings.{name} of {setups[i].name}{when}: not {expected}"
