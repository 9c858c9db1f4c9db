"""Environments, drivers, observers and scenes for the terminal: one line, a table, every field."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from textwrap import shorten
from typing import Any

import numpy as np
from pydantic import BaseModel
from rich.console import RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import listed
from coopenv.base.format import number
from coopenv.base.installation import environment_id, list_agents, list_envs
from coopenv.observers.registry import description, list_observers
from coopenv.policies import find_agent
from coopenv.report.table import Column, Table
from coopenv.runs import scenario_text
from coopenv.runs.scenario_text import settings, text_table
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.scenes import scene_rows
from coopenv.scenario.sensing import Camera, Noise
from coopenv.scenario.sensors import SensorSection
from coopenv.sources.registry import ENVIRONMENT, LOG, kinds

DESCRIPTION_LENGTH = 240  # characters of a scenario's description on the first screen


def summary(name: str, scenario: Scenario, recorded: bool = False) -> Iterator[RenderableType]:
    """Yield the first screen of an environment or a recording, part by part."""
    registered = f" ({environment_id(name)})" if name in list_envs() else ""
    yield Text(scenario.title, "bold").append(registered, "not bold")
    if scenario.description:
        yield shorten(scenario.description, DESCRIPTION_LENGTH, placeholder=" ...")
    if recorded:
        yield "Recorded: every episode is the recording, whatever the seed and the actions."
    table = RichTable.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    for subject, fact in facts(scenario).items():
        table.add_row(subject, fact)
    yield ""
    yield table


def facts(scenario: Scenario) -> dict[str, str]:
    """Return a line each on vehicles, sensors, radio, rates, observer, observation, action, reward and end."""
    layout, rates, noise, observer = observation_layout(scenario), scenario.rates, scenario.noise, scenario.observer
    groups = Counter[str]()
    for field in layout.values():
        groups[field.group] += field.stop - field.start
    corrections = "" if rates.observer is None else f", observer {number(rates.observer)}"
    spread = f"noise {number(noise.velocity)} m/s and {number(noise.angular_velocity)} rad/s"
    spread = spread if noise.enabled else "no noise"
    weights = [f"{number(weight)} {name}" for name, weight in scenario.reward.by_name.items() if weight]
    found = {
        "Vehicles": _vehicles(scenario),
        "Targets": _targets(scenario),
        "Camera": _camera(scenario) + _own(scenario, "camera"),
        "Odometry": f"linear and angular velocity, {spread}{_lasting(noise)}{_own(scenario, 'noise')}",
        "V2X": _v2x(scenario),
        "Observer": f"{observer.name} (gains k = {_gain(observer.k)}, q = {_gain(observer.q)})",
        "Rates": f"camera {number(rates.camera)} Hz, odometry {number(rates.odometry)}{corrections}, "
        f"decisions {number(rates.decision)}",
        "Observation": f"{groups.total()} numbers per vehicle: "
        + ", ".join(f"{group} {size}" for group, size in groups.items() if size),
    }
    if scenario.sensors:
        found["Sensors"] = "; ".join(_sensor(section) for section in scenario.sensors)
    if scenario.driven:
        spans = [f"{entry.name} {number(entry.low)} to {number(entry.high)} {entry.unit}" for entry in layout.action]
        found["Action"] = f"{len(spans)} numbers in [-1, 1]: {', '.join(spans)}{_own(scenario, 'dynamics')}"
    found["Reward"] = " + ".join(weights).replace("+ -", "- ") or "none: every weight is 0"
    return found | {"Ends": _end(scenario)}


def _joined(separator: str, *parts: object) -> str:
    """Return the parts that are there."""
    return separator.join(str(part) for part in parts if part)


def _several(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _span(values: Collection[float]) -> str:
    """Return `0.5`, or `0.5 to 2` where values differ."""
    low, high = min(values), max(values)
    return number(low) if low == high else f"{number(low)} to {number(high)}"


def _gain(value: float | tuple[float, ...] | dict[str, float]) -> str:
    return _span(value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,))


def _own(scenario: Scenario, part: str) -> str:
    """Return the vehicles that have a camera, noise or limits of their own."""
    names = [name for name, v in zip(scenario.vehicle_names, scenario.vehicles, strict=True) if getattr(v, part)]
    return f"; other for {listed(names)}" if names else ""


def _vehicles(scenario: Scenario) -> str:
    pairs = zip(scenario.limits, scenario.vehicles, strict=True)
    fastest = [own.max_speed for own, vehicle in pairs if vehicle.motion.kind == "driven"]
    others = len(scenario.vehicles) - len(fastest)
    goals = sum(vehicle.goal_radius > 0 for vehicle in scenario.vehicles)
    kind = "in traffic" if scenario.cosimulator else "prescribed" if fastest else "with prescribed motion"
    driven = fastest and f"{len(fastest)} driven by actions, up to {_span(fastest)} m/s"
    return _joined("; ", driven, others and f"{others} {kind}", goals and f"{goals} with a goal")


def _targets(scenario: Scenario) -> str:
    moving = sum(landmark.motion.kind != "static" for landmark in scenario.landmarks)
    mode = {
        "fixed": "fixed topology: every neighbour is measured in every frame",
        "sensed": "sensed topology: what is in the field of view and not hidden is measured",
    }[scenario.topology.mode]
    if scenario.sensing != "sensed":
        mode = {
            "ideal": "ideal sensing: every neighbour is measured in every frame",
            "blind": "blind sensing: nothing is measured",
            "images": f"images: tags ({scenario.images.family}) are detected in rendered frames",
        }[scenario.sensing]
    accuracy = f"{_span(scenario.landmark_std)} m" if scenario.landmark_std else ""
    notes = _joined(", ", moving and f"{moving} moving", accuracy and f"known to {accuracy}")
    landmarks = _several(len(scenario.landmarks), "landmark") + (f" ({notes})" if notes else "")
    buildings = scenario.obstacles and _several(len(scenario.obstacles), "building")
    return f"{_joined(', ', landmarks, len(scenario.vehicles) > 1 and 'other vehicles', buildings)}; {mode}"


def _camera(scenario: Scenario) -> str:
    camera, noise, noisy = scenario.camera, scenario.noise.bearing, scenario.noise.enabled
    correlated = noise.correlated
    if camera.model == "none":
        return "none"
    unit = "rad" if noise.model == "isotropic" else "on the image plane"
    off = _joined(
        " and ",
        camera.extrinsics_error and f"{number(camera.extrinsics_error)} rad",
        camera.extrinsics_position_error and f"{number(camera.extrinsics_position_error)} m",
        camera.extrinsics_walk and f"a walk of {number(camera.extrinsics_walk)} rad in a second",
    )
    seen = _joined(
        ", ",
        camera.model,
        camera.model == "pinhole" and f"{camera.image_size[0]} x {camera.image_size[1]} pixels",
        camera.range is not None and f"up to {number(camera.range)} m",
        camera.miss_probability and f"misses {number(100 * camera.miss_probability)} %",
    )
    spread = f"{noise.model} noise {number(noise.scale)} {unit}" if noisy else "no noise"
    return _joined(
        "; ",
        f"{seen}; bearings, {spread}",
        noisy and correlated.std and f"{number(correlated.std)} rad correlated over {number(correlated.time)} s",
        off and noisy and f"mounted off by {off} per axis",
        _late(camera, noisy),
    )


def _late(camera: Camera, noisy: bool) -> str:
    """Return the age of a camera's frames in words, with the deviations of its errors."""
    errors = [number(1000.0 * std) for std in (camera.latency_error, camera.latency_jitter) if std and noisy]
    return f"frames {' +- '.join([number(1000.0 * camera.latency), *errors])} ms old" if camera.is_late else ""


def _sensor(section: SensorSection) -> str:
    """Return a sensor beside the camera in words; the table of all sensors has its noise and limits."""
    label = section.label if section.label == section.kind else f"{section.label} ({section.kind})"
    towards = section.made.towards if section.towards is None else section.towards
    return label if towards == ("map",) else f"{label} to {' and '.join(towards)}"


def _lasting(noise: Noise) -> str:
    """Return the lasting errors of the odometry in words."""
    bias = np.degrees(np.max(noise.gyro_bias))
    errors = _joined(
        ", ",
        noise.odometry_scale and f"scale error {number(100 * noise.odometry_scale)} %",
        bias and f"gyro bias {number(bias)} deg/s",
        (noise.odometry_scale_walk or np.any(noise.gyro_bias_walk)) and "walking on",
        noise.slip.rate and f"{number(noise.slip.rate)} slips a second",
    )
    return f", {errors}" if errors and noise.enabled else ""


def _v2x(scenario: Scenario) -> str:
    radio = scenario.v2x
    return _joined(
        ", ",
        f"a message every {'frame' if radio.period == 1 else f'{radio.period} frames'}",
        f"delay {_several(radio.delay, 'frame')}",
        f"loss {number(100 * radio.loss)} %",
        radio.range is not None and f"range {number(radio.range)} m",
        radio.staleness is not None and f"unused when older than {number(radio.staleness)} s",
        scenario.topology.acyclic and radio.links == "neighbours" and "leaders to followers only",
    )


def _end(scenario: Scenario) -> str:
    steps, ends = round(scenario.horizon * scenario.rates.decision), scenario.termination
    own = (word for word in ("collision", "arrival") if scenario.driven and getattr(ends, word))
    causes = _joined(" or ", *own, *ends.own, ends.off_route and f"{number(ends.off_route)} m off its route")
    return f"after {number(scenario.horizon)} s, {steps} decisions" + (f"; for a vehicle at {causes}" if causes else "")


def document(name: str, scenario: Scenario) -> dict[str, Any]:
    """Return the output of `describe --json`: the scenario, and the layout of observation and action."""
    layout = observation_layout(scenario)
    return {
        "name": name,
        "id": environment_id(name) if name in list_envs() else None,
        "observation_size": layout.size,
        "observation": {field: {**vars(entry), "shape": list(entry.shape)} for field, entry in layout.items()},
        "action": [vars(entry) for entry in layout.action],
        "scenario": scenario.model_dump(mode="json"),
    }


SECTIONS = ("camera", "rates", "noise", "topology", "v2x", "observer", "observation", "reward", "termination")
DRIVEN_SECTIONS = ("dynamics", "action")
"""Sections that matter only where actions drive a vehicle."""

DRAWN_SECTIONS = ("randomisation", "difficulty")
"""Sections that are shown only if they differ from the default."""

KEY_WIDTH, VALUE_WIDTH = 31, 17
"""Characters of a setting's key, at most, and of its value."""


def describe_scenario(scenario: Scenario) -> Iterator[RenderableType]:
    """Yield everything about a scenario, part by part."""
    yield Text(f"{scenario.title}\n", "bold")
    for text in (scenario.description, scenario.source and f"Source: {scenario.source.strip()}"):
        if text:
            yield f"{' '.join(text.split())}\n"
    steps = round(scenario.horizon * scenario.rates.decision)
    yield f"Horizon: {scenario.horizon:g} s, {steps} decisions of {scenario.ticks_per_decision} camera ticks each.\n"
    for listing in scenario_text.scene(scenario):
        yield listing
        yield ""
    yield Text("Settings (* differs from the default)\n", "bold")
    parts = {name: getattr(scenario, name) for name in shown_sections(scenario)}
    parts |= {f"sensors.{sensor.label}": sensor for sensor in scenario.sensors}
    width = max(len(key) for part in parts.values() for key, *_ in settings(part)) + 2
    for name, part in parts.items():
        yield section_table(name, part, width)
        yield ""
    layout = observation_layout(scenario)
    rows = [
        (
            *(name, f"{field.start}:{field.stop}", "x".join(map(str, field.shape)), field.unit, number(field.scale)),
            f"{field.meaning}; center {number(field.center)}" if field.center else field.meaning,
        )
        for name, field in layout.items()
    ]
    title = f"Observation: {layout.size} entries per vehicle, each (value - center) / scale, clipped"
    yield text_table(("field", "slice", "shape", "unit", "scale", "meaning"), rows, title)


def shown_sections(scenario: Scenario) -> list[str]:
    """Return the names of the sections that matter in a scenario."""
    names = [*SECTIONS, *(DRIVEN_SECTIONS if scenario.driven else ())]
    return names + [name for name in DRAWN_SECTIONS if getattr(scenario, name) != type(getattr(scenario, name))()]


def section_table(name: str, part: BaseModel, key_width: int) -> Table:
    """Return one row per setting of a section: key, value, meaning with its unit."""
    look: dict[str, Any] = {"number": False, "wraps": True}
    columns = (
        Column("key", f"[{name}]", width=min(key_width, KEY_WIDTH), **look),
        Column("value", width=VALUE_WIDTH, **look),
        Column("meaning", **look),
    )
    rows = [*settings(part)]
    keys = [f"{key} *" if differs else key for key, *_, differs in rows]
    values = {"key": keys, "value": [row[1] for row in rows], "meaning": [row[2] for row in rows]}
    doc = " ".join((type(part).__doc__ or "").split())
    return Table(columns, values, title=doc, strong=[i for i, row in enumerate(rows) if row[3]])


COLUMNS = {
    "envs": ("name", "vehicles", "landmarks", "motion", "horizon_s"),
    "observers": ("name", "about"),
    "agents": ("name", "kind", "about"),
    "variants": ("name", "of", "about"),
    "scenes": ("name", "options", "about"),
    "sources": ("name", "ticks", "about"),
}
"""Columns of the rows that the tables show."""


def environment_rows(scenarios: Mapping[str, Scenario]) -> list[dict[str, Any]]:
    """Return a row per environment."""
    return [
        {
            "name": name,
            "title": scenario.title,
            "id": environment_id(name),
            "vehicles": len(scenario.vehicles),
            "landmarks": len(scenario.landmarks),
            "motion": "driven" if scenario.driven else "prescribed",
            "horizon_s": scenario.horizon,
        }
        for name, scenario in scenarios.items()
    ]


def list_rows(kind: str) -> Sequence[Mapping[str, Any]]:
    """Return the rows of `coopenv list`, for a key of `COLUMNS`."""
    if kind == "envs":
        return environment_rows({name: load_scenario(name) for name in list_envs()})
    if kind == "observers":
        return [{"name": name, "about": description(name)} for name in list_observers()]
    if kind == "scenes":
        return scene_rows()
    if kind == "sources":
        return source_rows()
    agents = map(find_agent, list_agents())
    return [
        {"name": a.name, "kind": a.kind, "environments": list(a.environments), "about": _sentence(a.description)}
        for a in agents
    ]


def source_rows() -> list[dict[str, Any]]:
    """Return a row per kind of source, of this package, its guests and installed packages."""
    return [
        {
            "name": name,
            "ticks": "recorded" if row.recorded else "live",
            "about": f"{row.title}: {row.example}" if row.example else row.title,
        }
        for name, row in {"environment": ENVIRONMENT, "log": LOG, **kinds()}.items()
    ]


def _sentence(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def list_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    """Return one row per entry; texts of the last column that do not fit into the width are wrapped."""
    shown = []
    for key in columns:
        title = key.removesuffix("_s") + (" [s]" if key.endswith("_s") else "")
        last, number = key == columns[-1], bool(rows) and isinstance(rows[0][key], int | float)
        shown.append(Column(key, title, number=number, wraps=last))
    return Table.of(shown, rows)
