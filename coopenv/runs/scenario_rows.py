"""A scenario as rows of texts: vehicles, routes, landmarks, motions, buildings, settings, fields of the observation."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from pydantic import BaseModel

from coopenv.api.terms.layout import observation_layout
from coopenv.base.format import number
from coopenv.runs import scenario_text as words
from coopenv.scenario.schema import Scenario
from coopenv.scenario.sensing import Camera

IMAGE_FIELDS = ("image_size", "focal_length", "principal_point", "distortion", "undistort", "quantise")
"""Settings of a camera that matter only where it has an image, as a pinhole camera does."""


class Listing(NamedTuple):
    """A table of texts; cells may have several lines."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def scene(scenario: Scenario, grouped: bool = True) -> Iterator[Listing]:
    """Yield the tables of who and what is there; those without rows are left out, as are their empty columns.

    `grouped` says whether landmarks that a group draws have rows of their own.
    """
    marks = landmarks(scenario, grouped)
    tables = (vehicles(scenario), routes(scenario), marks, groups(scenario), motions(scenario), buildings(scenario))
    yield from (_without_empty_columns(table) for table in tables if table.rows)


def _without_empty_columns(table: Listing) -> Listing:
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = [tuple(row[i] for i in kept) for row in table.rows]
    return Listing(table.title, tuple(table.columns[i] for i in kept), rows)


def vehicles(scenario: Scenario) -> Listing:
    """Return one row per vehicle: start, initial estimate, motion, neighbours."""
    columns = ("vehicle", "start", "initial estimate", "motion", "may measure")
    neighbours = words.neighbours(scenario)
    rows = [
        (name, words.start(vehicle), words.estimate(vehicle.initial_estimate), words.vehicle_motion(vehicle), targets)
        for name, vehicle, targets in zip(scenario.vehicle_names, scenario.vehicles, neighbours, strict=True)
    ]
    return Listing("Vehicles (m)", columns, rows)


def routes(scenario: Scenario) -> Listing:
    """Return one row per route."""
    rows = []
    for route in scenario.routes:
        points = ", ".join(words.vector(point) for point in route.waypoints)
        rows.append((route.name, points, f"radius {number(route.corner_radius)}", words.drawn_route(route)))
    return Listing("Routes (m)", ("route", "waypoints", "corners", "drawn"), rows)


def landmarks(scenario: Scenario, grouped: bool = True) -> Listing:
    """Return one row per landmark, those of groups included or not."""
    rows = [
        (mark.name, words.place(mark), words.motion(mark.motion), words.body(mark.body) or "none")
        for mark in scenario.landmarks
        if grouped or mark.group is None
    ]
    return Listing("Landmarks (m)", ("landmark", "position", "motion", "body"), rows)


def groups(scenario: Scenario) -> Listing:
    """Return one row per group of landmarks."""
    rows = [
        (group.name, str(group.count), words.areas(group), " to ".join(number(z) for z in group.height))
        for group in scenario.landmark_groups
    ]
    return Listing("Groups of landmarks (m)", ("group", "landmarks", "drawn in", "height"), rows)


def motions(scenario: Scenario) -> Listing:
    """Return one row per stage of every motion that is prescribed stage by stage."""
    moving = [*(v.motion for v in scenario.vehicles), *(m.motion for m in scenario.landmarks)]
    names = [*scenario.vehicle_names, *(m.name for m in scenario.landmarks)]
    rows = [
        ("" if i else name, time, stage)
        for name, motion in zip(names, moving, strict=True)
        for i, (time, stage) in enumerate(words.stages(motion))
    ]
    return Listing("Stages of motion (s)", ("who", "time", "motion"), rows)


def buildings(scenario: Scenario) -> Listing:
    """Return one row per building."""
    rows = []
    for obstacle in scenario.obstacles:
        yaw = words.orientation(obstacle.yaw, None) or ""
        size = " x ".join(number(edge) for edge in obstacle.size)
        rows.append((obstacle.name, words.vector(obstacle.center), size, yaw.removeprefix("yaw ")))
    return Listing("Buildings (m)", ("building", "centre", "size", "yaw"), rows)


def observation(scenario: Scenario) -> Listing:
    """Return one row per field of the flat observation."""
    layout, rows = observation_layout(scenario), []
    for name, field in layout.items():
        shape, part = "x".join(map(str, field.shape)), f"{field.start}:{field.stop}"
        meaning = f"{field.meaning}; center {number(field.center)}" if field.center else field.meaning
        rows.append((name, part, shape, field.unit, number(field.scale), meaning))
    title = f"Observation: {layout.size} entries per vehicle, each (value - center) / scale, clipped"
    return Listing(title, ("field", "slice", "shape", "unit", "scale", "meaning"), rows)


def settings(part: BaseModel, prefix: str = "") -> Iterator[tuple[str, str, str, bool]]:
    """Yield (dotted key, value, meaning, whether it differs from the default) of a section's fields that matter."""
    unused = IMAGE_FIELDS if isinstance(part, Camera) and part.model != "pinhole" else ()
    for name, info in type(part).model_fields.items():
        if name in unused:
            continue
        value = getattr(part, name)
        if isinstance(value, BaseModel):
            yield from settings(value, f"{prefix}{name}.")
        elif name == "custom":
            yield from ((f"custom.{key}", words.setting(row.function), row.meaning, True) for key, row in value.items())
        else:
            meaning = " ".join((info.description or "").split())
            yield f"{prefix}{name}", words.setting(value), meaning, value != info.get_default()
    for name, value in (part.model_extra or {}).items():
        yield f"{prefix}{name}", words.setting(value), "A term of one's own, see docs/terms.md", True
