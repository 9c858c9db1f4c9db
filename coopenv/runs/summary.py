"""Environments, drivers, observers and scenes for the terminal: one line, a table, every field."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from textwrap import shorten
from typing import Any

import numpy as np
from pydantic import BaseModel
from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import listed
from coopenv.base.format import number
from coopenv.base.installation import environment_id, list_agents, list_envs
from coopenv.observers.registry import description, observer_names
from coopenv.policies import find_agent
from coopenv.runs import scenario_text
from coopenv.runs.scenario_text import Listing, settings
from coopenv.scenario import Scenario
from coopenv.scenario.sensing import Noise

DESCRIPTION_LENGTH = 240  # characters of a scenario's description on the first screen


def summary(name: str, scenario: Scenario, recorded: bool = False) -> Iterator[RenderableType]:
    """Yield the first screen of an environment or a recording, part by part."""
    registered = f" ({environment_id(name)})" if name in list_envs() else ""
    yield Text(scenario.title, "bold").append(registered, "not bold")
    if scenario.description:
        yield shorten(scenario.description, DESCRIPTION_LENGTH, placeholder=" ...")
    if recorded:
        yield "Recorded: every episode is the recording, whatever the seed and the actions."
    table = Table.grid(padding=(0, 2))
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
    if scenario.driven:
        spans = [f"{entry.name} {number(entry.low)} to {number(entry.high)} {entry.unit}" for entry in layout.action]
        found["Action"] = f"{len(spans)} numbers in [-1, 1]: {', '.join(spans)}{_own(scenario, 'dynamics')}"
    found["Reward"] = " + ".join(weights).replace("+ -", "- ") or "none: every weight is 0"
    return found | {"Ends": _end(scenario)}


def _vehicles(scenario: Scenario) -> str:
    driven = sum(vehicle.motion.kind == "driven" for vehicle in scenario.vehicles)
    goals = sum(vehicle.goal_radius > 0 for vehicle in scenario.vehicles)
    fastest = [
        own.max_speed for own, v in zip(scenario.limits, scenario.vehicles, strict=True) if v.motion.kind == "driven"
    ]
    parts = [f"{driven} driven by actions, up to {_span(fastest)} m/s"] if driven else []
    prescribed = "prescribed" if driven else "with prescribed motion"
    others = f"{len(scenario.vehicles) - driven} " + ("in traffic" if scenario.highway else prescribed)
    parts += [others] if driven < len(scenario.vehicles) else []
    return "; ".join([*parts, *([f"{goals} with a goal"] if goals else [])])


def _targets(scenario: Scenario) -> str:
    moving = sum(landmark.motion.kind != "static" for landmark in scenario.landmarks)
    buildings = f", {_several(len(scenario.obstacles), 'building')}" if scenario.obstacles else ""
    mode = {
        "fixed": "fixed topology: every neighbour is measured in every frame",
        "sensed": "sensed topology: what is in the field of view and not hidden is measured",
    }[scenario.topology.mode]
    if scenario.sensing != "sensed":
        mode = {"ideal": "every neighbour is measured in every frame", "blind": "nothing is measured"}[scenario.sensing]
        mode = f"{scenario.sensing} sensing: {mode}"
    also = f" ({moving} moving)" if moving else ""
    others = ", other vehicles" if len(scenario.vehicles) > 1 else ""
    return f"{_several(len(scenario.landmarks), 'landmark')}{also}{others}{buildings}; {mode}"


def _several(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _camera(scenario: Scenario) -> str:
    camera, noise = scenario.camera, scenario.noise.bearing
    size = f", {camera.image_size[0]} x {camera.image_size[1]} pixels" if camera.model == "pinhole" else ""
    reach = f", up to {number(camera.range)} m" if camera.range is not None else ""
    misses = f", misses {number(100 * camera.miss_probability)} %" if camera.miss_probability else ""
    unit = "rad" if noise.model == "isotropic" else "on the image plane"
    spread = f", {noise.model} noise {number(noise.scale)} {unit}" if scenario.noise.enabled else ", no noise"
    off = [f"{number(camera.extrinsics_error)} rad"] if camera.extrinsics_error else []
    off += [f"{number(camera.extrinsics_position_error)} m"] if camera.extrinsics_position_error else []
    place = f"; mounted off by {' and '.join(off)} per axis" if off and scenario.noise.enabled else ""
    return f"{camera.model}{size}{reach}{misses}; bearings{spread}{place}"


def _lasting(noise: Noise) -> str:
    """Return the lasting errors of the odometry in words."""
    parts = [f"scale error {number(100 * noise.odometry_scale)} %"] if noise.odometry_scale else []
    bias = np.degrees(np.max(noise.gyro_bias))
    parts += [f"gyro bias {number(bias)} deg/s"] if bias else []
    walks = noise.odometry_scale_walk or np.any(noise.gyro_bias_walk)
    parts += ["walking on"] if walks else []
    parts += [f"{number(noise.slip.rate)} slips a second"] if noise.slip.rate else []
    return "".join(f", {part}" for part in parts) if noise.enabled else ""


def _v2x(scenario: Scenario) -> str:
    radio = scenario.v2x
    parts = [f"a message every {'frame' if radio.period == 1 else f'{radio.period} frames'}"]
    parts.append(f"delay {radio.delay} frame{'' if radio.delay == 1 else 's'}, loss {number(100 * radio.loss)} %")
    parts += [f"range {number(radio.range)} m"] if radio.range is not None else []
    parts += [f"unused when older than {number(radio.staleness)} s"] if radio.staleness is not None else []
    parts += ["leaders to followers only"] if scenario.topology.acyclic else []
    return ", ".join(parts)


def _gain(value: float | tuple[float, ...] | dict[str, float]) -> str:
    several = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,)
    return _span(several)


def _span(values: Collection[float]) -> str:
    """Return `0.5`, or `0.5 to 2` where values differ."""
    low, high = min(values), max(values)
    return number(low) if low == high else f"{number(low)} to {number(high)}"


def _own(scenario: Scenario, part: str) -> str:
    """Return which vehicles have a camera, noise or limits of their own."""
    names = [name for name, v in zip(scenario.vehicle_names, scenario.vehicles, strict=True) if getattr(v, part)]
    return f"; {listed(names)} with entries of their own" if names else ""


def _end(scenario: Scenario) -> str:
    steps = round(scenario.horizon * scenario.rates.decision)
    ends = scenario.termination
    causes = [word for word in ("collision", "arrival") if scenario.driven and getattr(ends, word)] + [*ends.own]
    causes += [f"{number(ends.off_route)} m off its route"] if ends.off_route else []
    early = f"; for a vehicle at {' or '.join(causes)}" if causes else ""
    return f"after {number(scenario.horizon)} s, {steps} decisions{early}"


def document(name: str, scenario: Scenario) -> dict[str, Any]:
    """Return what `describe --json` prints: the scenario, and the layout of observation and action."""
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

VALUE_WIDTH = 17
KEY_WIDTH, WHOLE_WIDTH = 31, 24
"""Characters at most, of a key and of a cell that is not broken into lines."""
WHOLE_COLUMNS = {"vehicle", "who", "time", "slice", "shape", "unit", "scale"}
"""Columns that are not broken into lines."""


def describe_scenario(scenario: Scenario) -> Iterator[RenderableType]:
    """Yield everything about a scenario, part by part."""
    yield Text(f"{scenario.title}\n", "bold")
    for text in (scenario.description, scenario.source and f"Source: {scenario.source.strip()}"):
        if text:
            yield f"{' '.join(text.split())}\n"
    steps = round(scenario.horizon * scenario.rates.decision)
    yield f"Horizon: {scenario.horizon:g} s, {steps} decisions of {scenario.ticks_per_decision} camera ticks each.\n"
    for listing in scenario_text.scene(scenario):
        yield listing_table(listing)
        yield ""
    yield Text("Settings (* differs from the default)\n", "bold")
    names = shown_sections(scenario)
    width = max(len(key) for name in names for key, *_ in settings(getattr(scenario, name))) + 2
    for name in names:
        yield section_table(name, getattr(scenario, name), width)
        yield ""
    yield listing_table(scenario_text.observation(scenario))


def shown_sections(scenario: Scenario) -> list[str]:
    """Return the names of the sections that matter in a scenario."""
    names = [*SECTIONS, *(DRIVEN_SECTIONS if scenario.driven else ())]
    return names + [name for name in DRAWN_SECTIONS if getattr(scenario, name) != type(getattr(scenario, name))()]


def listing_table(listing: Listing) -> Table:
    """Return a listing as a table."""
    table = _table(*listing.columns, title=listing.title)
    for i, (name, column) in enumerate(zip(listing.columns, table.columns, strict=True)):
        if name in WHOLE_COLUMNS:
            column.min_width = min(
                WHOLE_WIDTH, max(len(line) for row in listing.rows for line in row[i].splitlines() or [""])
            )
    for row in listing.rows:
        table.add_row(*row)
    return table


def section_table(name: str, part: BaseModel, key_width: int) -> Table:
    """Return one row per setting of a section: key, value, meaning with its unit."""
    doc = " ".join((type(part).__doc__ or "").split())
    table = _table(f"[{name}]", "value", "meaning", title=doc)
    table.columns[0].width, table.columns[1].width = min(key_width, KEY_WIDTH), VALUE_WIDTH
    for key, value, meaning, differs in settings(part):
        table.add_row(f"{key} *" if differs else key, value, meaning, style="bold" if differs else None)
    return table


def _table(*columns: str, title: str | None = None) -> Table:
    look: dict[str, Any] = {"title_justify": "left", "title_style": "italic"}
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, **look)
    for name in columns:
        table.add_column(name, overflow="fold")
    return table


COLUMNS = {
    "envs": ("name", "vehicles", "landmarks", "motion", "horizon_s"),
    "observers": ("name", "about"),
    "agents": ("name", "kind", "about"),
    "variants": ("name", "of", "about"),
    "scenes": ("name", "options", "about"),
}
"""What the tables show of the rows."""


def environment_rows() -> list[dict[str, Any]]:
    """Return the rows of `list envs`."""
    from coopenv.scenario import load_scenario

    rows = []
    for name in list_envs():
        scenario = load_scenario(name)
        rows.append(
            {
                "name": name,
                "title": scenario.title,
                "id": environment_id(name),
                "vehicles": len(scenario.vehicles),
                "landmarks": len(scenario.landmarks),
                "motion": "driven" if scenario.driven else "prescribed",
                "horizon_s": scenario.horizon,
            }
        )
    return rows


def observer_rows() -> list[dict[str, Any]]:
    """Return the rows of `list observers`."""
    return [{"name": name, "about": description(name)} for name in observer_names()]


def agent_rows() -> list[dict[str, Any]]:
    """Return the rows of `list agents`."""
    return [
        {
            "name": agent.name,
            "kind": agent.kind,
            "environments": list(agent.environments),
            "about": _sentence(agent.description),
        }
        for agent in map(find_agent, list_agents())
    ]


def _sentence(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def list_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    """Return one row per entry; texts of the last column that do not fit into the width are wrapped."""
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for key in columns:
        heading = key.removesuffix("_s") + (" [s]" if key.endswith("_s") else "")
        number = bool(rows) and isinstance(rows[0][key], int | float)
        table.add_column(heading, justify="right" if number else "left", no_wrap=key != columns[-1])
    for row in rows:
        table.add_row(*(_text(row[key]) for key in columns))
    return table


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
