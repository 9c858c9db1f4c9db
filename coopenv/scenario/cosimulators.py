"""Sections of the programs that may move the vehicles in place of coopenv, see docs/backends.md.

A package offers its own program, a `coopenv.sources.cosimulation.TrafficProgram`, under the entry point group
`coopenv.cosimulators`. In a scenario its name is that of the `backend`, and its section holds its further arguments.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

from pydantic import Field, JsonValue

from coopenv.base import units
from coopenv.base.plugins import call, offered
from coopenv.base.sections import NonNegative, Positive, Section, Word

GROUP = "coopenv.cosimulators"

File = Annotated[str, Field(min_length=1, max_length=1_000)]
"""A path; a relative one is looked for beside the scenario's file."""


class Cosimulator(Section):
    """Section of a program that moves the vehicles. A subclass is a field of `Scenario`, named as in `backend`."""

    title: ClassVar[str]
    """Name of the program."""
    program: ClassVar[str]
    """Its `coopenv.sources.cosimulation.TrafficProgram`, `module:class`, made from the scenario."""
    files: ClassVar[tuple[str, ...]] = ()
    """Keys that name files or code of the user's own."""
    unrecorded: ClassVar[Mapping[str, Any]] = {}
    """Values in recordings, which name neither files nor code."""
    completion: ClassVar[str] = ""
    """Function, `module:name`, that adds the content of the files to the plain data of a scenario."""
    reference_midway: ClassVar[bool] = False
    """True if its vehicles' reference point is midway between the axles instead of on the rear axle."""

    most_vehicles: int = Field(default=40, ge=0, le=10_000)
    """Largest number of vehicles on its road besides this file's: traffic that only occludes and collides."""

    @property
    def roads(self) -> str:
        """Source of roads and traffic, in words."""
        return self.title


class Highway(Cosimulator):
    """Roads, traffic (IDM and MOBIL) and dynamics of an environment of highway-env, see docs/highway.md."""

    title = "highway-env"
    program = "coopenv.highway.program:Simulation"
    reference_midway = True

    id: Annotated[str, Field(max_length=64, pattern=r"^[a-z0-9][A-Za-z0-9-]*-v\d+$")]
    """Id in Gymnasium's registry, such as `intersection-v0`."""
    config: dict[str, JsonValue] = Field(default={})
    """Configuration of the environment by key; this file's settings (rates, sizes of actions) are not repeated here."""
    dynamical: bool = False
    """Give driven vehicles tyres that slip (highway-env's BicycleVehicle); otherwise its kinematic bicycle."""

    @property
    def roads(self) -> str:
        """Source of roads and traffic, in words."""
        return f"{self.title}'s `{self.id}`"


class Sumo(Cosimulator):
    """Network, routes and traffic of SUMO, see docs/sumo.md."""

    title = "SUMO"
    program = "coopenv.sumo.program:SumoProgram"
    files = ("net", "routes", "additional")
    unrecorded = MappingProxyType({"net": "not_recorded", "routes": [], "additional": [], "included": True})
    completion = "coopenv.sumo.files:with_sumo"
    traffic_options: ClassVar = ("ignore-route-errors", "lateral-resolution", "scale", "step-method.ballistic")
    """Options that a configuration may set. None names a file that SUMO would write."""

    most_vehicles: int = Field(default=1_000, ge=0, le=10_000)
    """Largest number of vehicles on its road besides this file's: traffic that only occludes and collides."""
    net: File
    """Network (`.net.xml`, as of netconvert or netgenerate), or a configuration with its other files (`.sumocfg`)."""
    routes: tuple[File, ...] = Field(default=(), max_length=100)
    """Routes, trips and flows (`.rou.xml`)."""
    additional: tuple[File, ...] = Field(default=(), max_length=100)
    """Further files (`.add.xml`): polygons, points of interest, types of vehicles."""
    begin: Annotated[NonNegative, units.CLOCK] = 0.0
    """SUMO's time at which the traffic begins, s."""
    warm_up: Annotated[NonNegative, units.TIME] = 60.0
    """Traffic before the episode begins, s."""
    posts: bool = True
    """Place a landmark beside the stop line of every road into a junction: at the right, left where traffic is."""
    post_height: Annotated[Positive, units.EXTENT] = 3.0
    landmarks: Word = "landmark"
    """Points of interest whose type begins so are landmarks, at their parameter `height` or `post_height`."""
    buildings: Word = "building"
    """Polygons whose type begins so are obstacles, up to their parameter `height` or `building_height`."""
    building_height: Annotated[Positive, units.EXTENT] = 10.0
    options: dict[str, JsonValue] = Field(default={})
    """SUMO's own options by name, without options that follow from settings of this file."""
    included: bool = False
    """True if this file contains the roads, landmarks, buildings and routes of SUMO's files; written by coopenv."""


class Program(Cosimulator):
    """A program of the user's own."""

    title = "the program"
    program = "coopenv.sources.cosimulation:own_program"
    files = ("code",)
    unrecorded = MappingProxyType({"code": "not_recorded:none"})

    code: Annotated[str, Field(min_length=1, max_length=1_000, pattern=":")]
    """Class that is made from the scenario, `file.py:Class`."""
    options: dict[str, JsonValue] = Field(default={})
    """Further arguments of the class, by name."""


COSIMULATORS: Mapping[str, type[Cosimulator]] = {"highway": Highway, "sumo": Sumo, "program": Program}
"""Co-simulators by their names in `backend`, which are fields of `Scenario`."""

FILES: Mapping[str, tuple[str, ...]] = {name: section.files for name, section in COSIMULATORS.items() if section.files}
"""Keys of sections that name files or code of the user's own."""


def completed(raw: Any) -> Any:
    """Return the plain data of a scenario with what its co-simulator adds; another package's becomes a `[program]`.

    What is not as it should be is left for the schema to complain about.

    Raises:
        ScenarioError: a file cannot be read.
    """
    name = raw.get("backend") if isinstance(raw, Mapping) else None
    if not isinstance(name, str) or name == "simulated":
        return raw
    if name in COSIMULATORS:
        return call(place, raw) if (place := COSIMULATORS[name].completion) else raw
    if "program" in raw or name not in (points := offered(GROUP)):
        return raw
    options = raw.get(name, {})
    known = {key: options[key] for key in ("most_vehicles",) if isinstance(options, dict) and key in options}
    options = {key: value for key, value in options.items() if key not in known} if known else options
    program = {"code": points[name].value, "options": options, **known}
    return {**{key: value for key, value in raw.items() if key != name}, "backend": "program", "program": program}
