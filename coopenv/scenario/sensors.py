"""Sensors beside the camera: what each one measures, on which vehicles, towards what, and how well."""

import json
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from coopenv.base import units
from coopenv.base.errors import CoopenvError, check_one_of, shown
from coopenv.base.installation import check_reference, is_reference
from coopenv.base.sections import NonNegative, Positive, QuaternionWxyz, Rate, Section, Vector3
from coopenv.measurements.table import KINDS
from coopenv.scenario.sensing import rotation_of

if TYPE_CHECKING:
    from coopenv.estimation.poses import Array
    from coopenv.measurements.kinds import Kind

GROUPS = ("landmarks", "vehicles", "anchors", "map")
"""Targets of a sensor, beside single landmarks and vehicles by name."""
MOST_SENSORS = 16
ByRow = NonNegative | tuple[NonNegative, ...]
"""A number for every row of a measurement, or one for each."""


class Correlated(Section):
    """An error that changes slowly, as by multipath: a Gauss-Markov process of first order in each row."""

    std: ByRow = 0.0
    """Standard deviation of every row, or one for each, in the units of the noise."""
    time: Annotated[Positive, units.TIME] = 10.0
    """Correlation time, s."""


class Outages(Section):
    """Times without any measurement of the sensor, drawn per vehicle."""

    rate: NonNegative = 0.0
    """Outages begin so often, 1/s."""
    duration: Annotated[Positive, units.TIME] = 5.0
    """Mean duration, s; durations are exponentially distributed."""


class Outliers(Section):
    """Measurements that are wrong, as a range by a reflection; drawn per target and measurement."""

    probability: units.Chance = 0.0
    size: ByRow = 5.0
    """Mean of an exponentially distributed error that is added to every row, or one for each, in their units."""


class SensorSection(Section):
    """A sensor beside the camera."""

    kind: str = Field(min_length=1, max_length=1_000)
    """A kind of coopenv, or `file.py:Class`, see docs/contributing/sensor.md."""
    name: str = Field(default="", max_length=64, pattern=r"^([A-Za-z][A-Za-z0-9_]*)?$")
    """Name in ticks, logs and tables (default: the kind, or the name of the class in lower case)."""
    vehicles: tuple[str, ...] | None = None
    """Names of the vehicles that have it (default: all)."""
    towards: tuple[str, ...] | None = None
    """Its targets: `landmarks`, `vehicles`, `anchors` (landmarks for radios, which cameras do not see), `map`, and
    names of landmarks, groups and vehicles (default: the kind's own)."""
    rate: Annotated[Rate | None, units.FREQUENCY] = None
    """Measurements per second, at the nearest camera ticks (none: at every tick)."""
    position: Annotated[Vector3, units.LENGTH] = (0.0, 0.0, 0.0)
    """Place in the body frame, m."""
    orientation: Literal["body"] | QuaternionWxyz = "body"
    """Sensor to body: `body` has the body's own axes, x forward; or a quaternion [w, x, y, z]."""
    noise: Positive | tuple[Positive, ...] | None = None
    """Standard deviation of every row, or one for each (default: the kind's own)."""
    range: Annotated[Positive | None, units.DISTANCE] = None
    """Farthest distance of a target, m (none: unlimited)."""
    field_of_view: Annotated[Positive | None, units.HEADING] = None
    """Full angle of the cone about the sensor's x axis in which targets lie, rad (none: every direction)."""
    occluded: bool = True
    """Whether buildings and bodies hide a target behind them, and buildings above a receiver of `position` the sky."""
    miss_probability: units.Chance = 0.0
    """Chance that a measurement is lost, drawn per target and measurement."""
    bias: ByRow = 0.0
    """Standard deviation of a constant error of every row, or one for each, drawn per vehicle and episode."""
    correlated: Correlated = Correlated()
    outages: Outages = Outages()
    outliers: Outliers = Outliers()
    options: dict[str, Any] = Field(default={})
    """Arguments of a class of one's own."""

    @property
    def arguments(self) -> str:
        """The options as JSON."""
        return json.dumps(self.options, sort_keys=True)

    @property
    def made(self) -> "Kind":
        """Its kind. Raises CoopenvError: it cannot be used."""
        from coopenv.measurements.sensor import kept_kind  # which reading a scenario does not need

        return kept_kind(self.kind, self.arguments)

    def by_row(self, key: str, given: float | Sequence[float]) -> "Array":
        """Return the numbers of a key, (rows,). Raises CoopenvError: there are not as many as rows."""
        numbers, rows = np.atleast_1d(np.array(given, float)), self.made.rows
        if len(numbers) not in (1, rows):
            raise CoopenvError(f"sensors.{self.label}.{key}: {len(numbers)} numbers for {rows} rows")
        return np.broadcast_to(numbers, rows)

    @property
    def white(self) -> "Array":
        """(rows,) standard deviations of white noise. Raises CoopenvError: there are not as many as rows."""
        return self.by_row("noise", self.made.noise if self.noise is None else self.noise)

    def counted(self, camera: float) -> "Array":
        """Return standard deviations (rows,) by which filters count its noise; `camera` is the rate of ticks, Hz."""
        period = 1.0 / min(self.rate or math.inf, camera)
        from coopenv.measurements.sensor import averaged_std

        correlated = self.by_row("correlated.std", self.correlated.std)
        return averaged_std(self.white, correlated, self.correlated.time, period)

    @property
    def mounting(self) -> "Array":
        """(3, 3) sensor to body."""
        return np.asarray(rotation_of(None, None if self.orientation == "body" else self.orientation))

    def is_on(self, vehicle: str) -> bool:
        """Return whether a vehicle of a name has it."""
        return self.vehicles is None or vehicle in self.vehicles

    def measures(self, scenario: Any, target: int) -> bool:
        """Return whether a target is among those that it measures, by name, group or sort."""
        if not self.made.has_target:
            return False
        towards, marks = self.made.towards if self.towards is None else self.towards, scenario.landmarks
        if target >= len(marks):
            return "vehicles" in towards or scenario.vehicle_names[target - len(marks)] in towards
        mark = marks[target]
        return bool({"anchors" if mark.anchor else "landmarks", mark.name, mark.group} & {*towards})

    @property
    def label(self) -> str:
        """Its name, given or by its kind."""
        return self.name or self.kind.rpartition(":")[2].lower()

    @model_validator(mode="after")
    def _kind_exists(self) -> Self:
        if is_reference(self.kind):
            try:
                check_reference(self.kind)
            except CoopenvError as error:
                raise ValueError(f"kind: {error}") from None
        elif self.options:
            raise ValueError(f"options: for a class of one's own, not for '{self.kind}'")
        else:
            check_one_of("kind: unknown kind of sensor", self.kind, KINDS, ValueError)
        return self


def problems_of_sensors(
    sensors: Sequence[SensorSection], vehicles: Sequence[str], targets: Sequence[str], groups: Sequence[str]
) -> Iterator[str]:
    """Yield the conflicts of sensors with each other, with vehicles and with targets, all by name."""
    names = [sensor.label for sensor in sensors]
    for i, sensor in enumerate(sensors):
        if names.index(names[i]) != i or names[i] == "camera":
            yield f"sensors.{i}.name: the name {shown(names[i])} is used twice"
        known: dict[str, Sequence[str]] = {
            "vehicles": vehicles,
            "towards": [*GROUPS, *targets, *groups],
        }
        for key, allowed in known.items():
            for name in [name for name in getattr(sensor, key) or () if name not in allowed][:1]:
                check_one_of(f"sensors.{i}.{key}: unknown name", name, allowed, ValueError)
