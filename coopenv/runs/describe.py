"""Scenarios printed for people, in 80 columns."""

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from coopenv.api.terms.layout import observation_layout
from coopenv.format import number
from coopenv.runs import scenario_text as words
from coopenv.scenario.schema import Scenario
from coopenv.scenario.sensing import Camera

SECTIONS = ("camera", "rates", "noise", "topology", "v2x", "observer", "observation", "reward", "termination")
DRIVEN_SECTIONS = ("dynamics", "action")
"""Sections that matter only where actions drive a vehicle."""

DRAWN_SECTIONS = ("randomisation", "difficulty")
"""Sections that are shown only where they say something."""

VALUE_WIDTH = 17

IMAGE_FIELDS = ("image_size", "focal_length", "principal_point", "distortion", "undistort", "quantise")
"""Settings of a camera that matter only where it has an image, as a pinhole camera does."""


def describe_scenario(scenario: Scenario) -> Iterator[RenderableType]:
    """Yield everything about a scenario, part by part."""
    yield Text(f"{scenario.title}\n", "bold")
    for text in (scenario.description, scenario.source and f"Source: {scenario.source.strip()}"):
        if text:
            yield f"{' '.join(text.split())}\n"
    steps = round(scenario.horizon * scenario.rates.decision)
    yield f"Horizon: {scenario.horizon:g} s, {steps} decisions of {scenario.ticks_per_decision} camera ticks each.\n"
    for table in (vehicle_table, route_table, landmark_table, group_table, motion_table, obstacle_table):
        if (shown := table(scenario)).row_count:
            yield shown
            yield ""
    yield Text("Settings (* differs from the default)\n", "bold")
    names = [*SECTIONS, *(DRIVEN_SECTIONS if scenario.driven else ())]
    names += [name for name in DRAWN_SECTIONS if getattr(scenario, name) != type(getattr(scenario, name))()]
    width = max(len(key) for name in names for key, *_ in settings(getattr(scenario, name))) + 2
    for name in names:
        yield section_table(name, getattr(scenario, name), width)
        yield ""
    yield observation_table(scenario)


def vehicle_table(scenario: Scenario) -> Table:
    """Return one row per vehicle: start, initial estimate, motion, neighbours."""
    table = _table("vehicle", "start", "initial estimate", "motion", "may measure", title="Vehicles (m)")
    table.columns[0].no_wrap = True
    neighbours = words.neighbours(scenario)
    for name, vehicle, targets in zip(scenario.vehicle_names, scenario.vehicles, neighbours, strict=True):
        estimate = words.estimate(vehicle.initial_estimate)
        table.add_row(name, words.start(vehicle), estimate, words.vehicle_motion(vehicle), targets)
    return table


def route_table(scenario: Scenario) -> Table:
    """Return one row per route."""
    table = _table("route", "waypoints", "corners", "drawn", title="Routes (m)")
    for route in scenario.routes:
        points = ", ".join(words.vector(point) for point in route.waypoints)
        table.add_row(route.name, points, f"radius {number(route.corner_radius)}", words.drawn_route(route))
    return table


def group_table(scenario: Scenario) -> Table:
    """Return one row per group of landmarks."""
    table = _table("group", "landmarks", "drawn in", "height", title="Groups of landmarks (m)")
    for group in scenario.landmark_groups:
        height = " to ".join(number(z) for z in group.height)
        table.add_row(group.name, str(group.count), words.areas(group), height)
    return table


def landmark_table(scenario: Scenario) -> Table:
    """Return one row per landmark."""
    table = _table("landmark", "position", "motion", "body", title="Landmarks (m)")
    for mark in scenario.landmarks:
        motion, body = words.motion(mark.motion), words.body(mark.body) or "none"
        table.add_row(mark.name, words.place(mark), motion, body)
    return table


def motion_table(scenario: Scenario) -> Table:
    """Return one row per stage of every motion that is prescribed stage by stage."""
    table = _table("who", "time", "motion", title="Stages of motion (s)")
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    motions = [*(v.motion for v in scenario.vehicles), *(m.motion for m in scenario.landmarks)]
    names = [*scenario.vehicle_names, *(m.name for m in scenario.landmarks)]
    for name, motion in zip(names, motions, strict=True):
        for i, (time, stage) in enumerate(words.stages(motion)):
            table.add_row("" if i else name, time, stage)
    return table


def obstacle_table(scenario: Scenario) -> Table:
    """Return one row per building."""
    table = _table("building", "centre", "size", "yaw", title="Buildings (m)")
    for obstacle in scenario.obstacles:
        yaw = words.orientation(obstacle.yaw, None) or ""
        size = " x ".join(number(edge) for edge in obstacle.size)
        table.add_row(obstacle.name, words.vector(obstacle.center), size, yaw.removeprefix("yaw "))
    return table


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


def section_table(name: str, part: BaseModel, key_width: int) -> Table:
    """Return one row per setting of a section: key, value, meaning with its unit."""
    doc = " ".join((type(part).__doc__ or "").split())
    table = _table(f"[{name}]", "value", "meaning", title=doc)
    table.columns[0].width, table.columns[1].width = key_width, VALUE_WIDTH
    for key, value, meaning, differs in settings(part):
        table.add_row(f"{key} *" if differs else key, value, meaning, style="bold" if differs else None)
    return table


def observation_table(scenario: Scenario) -> Table:
    """Return one row per field of the flat observation."""
    layout = observation_layout(scenario)
    title = f"Observation: {layout.size} entries per vehicle, each (value - center) / scale, clipped"
    table = _table("field", "slice", "shape", "unit", "scale", "meaning", title=title)
    for column in table.columns[:-1]:
        column.no_wrap = True
    for name, field in layout.items():
        shape, part = "x".join(map(str, field.shape)), f"{field.start}:{field.stop}"
        meaning = f"{field.meaning}; center {number(field.center)}" if field.center else field.meaning
        table.add_row(name, part, shape, field.unit, number(field.scale), meaning)
    return table


def _table(*columns: str, title: str | None = None) -> Table:
    look: dict[str, Any] = {"title_justify": "left", "title_style": "italic"}
    return Table(*columns, title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, **look)
