"""Pages of environments: text, picture, film and measured figures of each, and an index."""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.base.files import check_file, replace_text, replacing_file, writing
from coopenv.base.format import json_text, number
from coopenv.base.installation import environment_id, list_envs, version
from coopenv.base.seeds import world_keys
from coopenv.bench.cards import OVERVIEW, Contest, cells, rendered
from coopenv.episode import Episode, Origin
from coopenv.evaluation.metrics import SCORE
from coopenv.policies import agents_for
from coopenv.runs import scenario_text
from coopenv.runs.films import Shot, space_film, top_view_film, write_film
from coopenv.runs.scenario_text import drawn, graded
from coopenv.runs.scenes import driver_of, scene_of
from coopenv.runs.summary import cell_text, environment_rows, facts, shown_sections
from coopenv.scenario import Scenario
from coopenv.scenario.terms import REWARD_TERMS, TERMINATION_CONDITIONS
from coopenv.viz.topview import TopView

FORMATS, MOST_BYTES = ((6.0, 448), (3.0, 320), (3.0, 240)), 280_000
"""Formats of films: pictures a second and width, px; the first within the limit counts, or the last. Limit in bytes."""
_LASTS = 8.0  # s, at most
_SEED = 0
_IDLE = "zero"  # the driver of a scene without a route


def films(name: str, scenario: Scenario, folder: Path) -> Iterator[str]:
    """Yield the films in a folder and their contents."""
    views = {"from above": folder / f"{name}.webp", "in 3-D": space_path(name, folder)}
    shown = [f"![Film of {name}, {view}]({path.name})" for view, path in views.items() if path.is_file()]
    if shown:
        _, driver = driver_of(None, scenario, name, _SEED)
        driven = f" driven by `{driver}`," if driver else ""
        estimated = f" estimated by `{scenario.observer.name}`"
        yield from shown
        yield f"The episode of seed {_SEED},{driven}{estimated}, faster than real time: the time stands above the map."
    if len(shown) > 1:
        yield (
            "In 3-D, solid cars are true and faded ones estimated. A car is lost while it is farther from its "
            "estimate than it is long."
        )


def space_path(name: str, folder: Path) -> Path:
    """Return the path of an environment's 3-D film."""
    return folder / f"{name}_3d.webp"


def write_page_films(name: str, scenario: Scenario, folder: Path, on_progress: Callable[[float], None]) -> None:
    """Film an environment for the page in a folder; where nothing moves there is no film.

    Those that are driven are filmed in 3-D too, where the extra is installed: behind the vehicle that drives longest,
    until it leaves the scene.
    """
    path, space = folder / f"{name}.webp", space_path(name, folder)
    policy, driver = driver_of(None, scenario, name, _SEED)
    kinds = [vehicle.motion.kind for vehicle in scenario.vehicles] + [mark.motion.kind for mark in scenario.landmarks]
    if driver == _IDLE or not (driver or {*kinds} - {"static"}):
        path.unlink(missing_ok=True)
        return
    with closing(Engine(scenario)) as engine:
        source = Origin.of(name, scenario, policy=driver, seed=_SEED)
        record = scene_of(engine, source, policy, lambda share: on_progress(share / 2))
    _write_small(lambda width: top_view_film(record, False), path, record, lambda share: on_progress(0.5 + share / 4))
    if scenario.driven and find_spec("pyvista"):
        longest = int(np.isfinite(record["position_error"]).sum(axis=0).argmax())
        frames = [record.frame(k) for k in range(len(record))]
        distance = np.abs([frame.target_position[:, :2] for frame in frames]).max(axis=-1)
        near = distance[:, len(scenario.landmarks) + longest] <= 1.1 * np.nanmax(distance[0])  # of all at the start
        inside = record.of(np.flatnonzero(near))
        behind = partial(space_film, [("", inside)], cameras=("follow",), vehicle=longest)
        _write_small(behind, space, inside, lambda share: on_progress(0.75 + share / 4))


def _write_small(
    film: Callable[[int], list[list[Shot]]], path: Path, record: Episode, on_progress: Callable[[float], None]
) -> None:
    """Write the film of a width in the first of the formats that makes no larger file."""
    for fps, width in FORMATS:
        write_film(film(width), path, fps, max(1.0, record.length / _LASTS), width, on_progress)
        if path.stat().st_size <= MOST_BYTES:
            break


SETTINGS = ("ideal", "sensed", "blind")
"""Values of the key `sensing` of the scenario; all else is equal."""
DRIVERS = ("route_follower", "peek")
"""A driver that looks straight ahead, and one that plans its view."""
TEAM_DRIVERS = ("look_ahead", "team_look_ahead")
"""A driver that plans for itself, and one that plans for the fleet."""
KEYS = ("sensing", "agent", "metric", "mean", "ci_low", "ci_high", "n")


def measured_drivers(name: str) -> tuple[str, ...]:
    """Return the drivers by which cooperation, or else sensing, is measured: if both were made for the environment."""
    made = {*agents_for(name)}
    return next((drivers for drivers in (TEAM_DRIVERS, DRIVERS) if {*drivers} <= made), ())


def cooperation_settings(scenario: Scenario) -> dict[str, Mapping[str, Any]]:
    """Return overrides of the scenario by the name of the setting: without bearings to cars, messages, or lies."""
    hidden = {f"vehicles.{i}.marker": (0.0, 0.0, 9.0) for i in range(len(scenario.vehicles))}  # m; above all images
    lies = [i for i, faults in enumerate(scenario.all_faults) if faults.lie.kind != "none"]
    honest = {"no lies": {f"vehicles.{i}.faults.lie.kind": "none" for i in lies}} if lies else {}
    return {"as it is": {}, "cars unseen": hidden, "radio off": {"v2x.range": 1e-3}, **honest}


def studied(name: str, scenario: Scenario) -> tuple[tuple[str, ...], dict[str, Mapping[str, Any]]]:
    """Return the drivers that are measured, and the overrides of each setting that they are measured at."""
    if measured_drivers(name) == TEAM_DRIVERS:
        learned = [agent for agent in agents_for(name) if agent == f"{name}_team"]
        return (*TEAM_DRIVERS, *learned), cooperation_settings(scenario)
    shared = cooperation_settings(scenario) if sum(scenario.acting) > 1 else {}
    shared.pop("as it is", None)  # equal to "sensed"
    return DRIVERS, {how: {"sensing": how} for how in SETTINGS} | shared


def contests(environment: str, scenario: Scenario, worlds: int) -> dict[str, Contest]:
    """Return the drivers that are measured, built, by the name of the setting.

    Raises:
        CoopenvError: one cannot drive here, or nothing is driven.
    """
    drivers, settings = studied(Path(environment).stem, scenario)
    return {how: Contest.of(environment, overrides, drivers, worlds) for how, overrides in settings.items()}


def write_figures(
    environment: str, scenario: Scenario, folder: Path, worlds: int, on_progress: Callable[[float, str], None]
) -> None:
    """Measure the value of sensing, or cooperation, in an environment, and write it for the page.

    Both drivers drive in the same held-out worlds at every setting.

    Args:
        environment: name or TOML file.
        scenario: the present scenario.
        folder: of the page.
        worlds: number of worlds.
        on_progress: called with the share that is done, and the driver.
    """
    rows: list[dict[str, Any]] = []
    built = contests(environment, scenario, worlds)
    for place, (how, contest) in enumerate(built.items()):

        def report(done: float, name: str, place: int = place, how: str = how, of: int = len(contest.entrants)) -> None:
            on_progress((place + done / of) / len(built), f"{how}: {name}")

        found = contest.drive(report).rows
        rows += [{key: {"sensing": how, **row}[key] for key in KEYS} for row in found if row["metric"] in OVERVIEW]
    value = {"coopenv": version(), "score": SCORE, "worlds": worlds, "scenario": fingerprint(scenario), "rows": rows}
    replace_text(folder / f"{Path(environment).stem}.json", json_text(value))


def read_value_of_sensing(path: Path) -> dict[str, Any] | None:
    """Return the earlier measurement; None without one.

    Raises:
        CoopenvError: the file holds something else.
    """
    if not path.exists():
        return None
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if "text" not in value:
            _rows(value)
        return {key: value[key] for key in ("coopenv", "worlds", "scenario", "text" if "text" in value else "rows")} | {
            "score": value.get("score", 1)
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise CoopenvError(f"{path}: no figures of a page ({why}); --measure makes them anew") from None


def value_of_sensing_text(environment: str, scenario: Scenario, value: Mapping[str, Any]) -> str:
    """Return the figures in Markdown, with the commands that give them; `text` is what a benchmark has written."""
    changed = value["scenario"] != fingerprint(scenario)
    if "text" in value:
        note = "*The environment has changed since these figures were measured.*\n\n" if changed else ""
        return f"{note}{value['text']}"
    rows = _rows(value)
    return rendered(
        "sensing.md.j2",
        environment=environment,
        team=measured_drivers(environment) == TEAM_DRIVERS,
        shared=any(how == "radio off" for how, _ in rows),
        drivers=studied(environment, scenario)[0],
        rows=rows,
        worlds=value["worlds"],
        score=value.get("score", 1),
        coopenv=value["coopenv"],
        changed=changed,
    ).strip()


def _rows(value: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """Return the cells of the table by setting and agent."""
    found = {(row["sensing"], row["agent"], row["metric"]): row for row in value["rows"]}
    return {
        (how, agent): cells({metric: found[how, agent, metric] for metric in OVERVIEW}, OVERVIEW)
        for how, agent, first in found
        if first == OVERVIEW[0]
    }


def fingerprint(scenario: Scenario) -> str:
    """Return a digest of a scenario's settings, without its texts and without defaults."""
    settings = scenario.model_dump(mode="json", exclude_unset=True, exclude={"title", "description", "source"})
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


INDEX = "README.md"
COLOURS, REFINED = 256, 2
"""Palette size of a picture, which saves two thirds of the bytes of a drawing, and rounds that improve the palette."""


def prepare(folder: Path, names: list[str]) -> None:
    """Make the folder of pages and find out before any work whether they can be written there.

    Raises:
        OutputError: they cannot.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        for end in (".md", ".png", ".webp", "_3d.webp", ".json"):
            check_file(folder / f"{name}{end}")


def environment_page(name: str, scenario: Scenario, folder: Path) -> str:
    """Return the page of an environment, with the figures and the film that stand in the folder, if any do."""
    value = read_value_of_sensing(folder / f"{name}.json")
    measured = "" if value is None else value_of_sensing_text(name, scenario, value)
    head = _head(name, scenario, films(name, scenario, folder))
    return "\n\n".join([*head, *_scene(scenario), *_learning(scenario), *_end(name, measured)]) + "\n"


def write_page(name: str, scenario: Scenario, folder: Path, on_film: Callable[[float], None] | None = None) -> None:
    """Write text and picture of an environment's page to a folder.

    Args:
        name: of the environment.
        scenario: its scenario.
        folder: which `prepare` has made.
        on_film: called with the share of its film that is done (None: no film is made, one that is there stays).

    Raises:
        CoopenvError: the figures that stand in the folder cannot be read.
    """
    read_value_of_sensing(folder / f"{name}.json")  # before anything is drawn
    if on_film is not None:
        write_page_films(name, scenario, folder, on_film)
    text = environment_page(name, scenario, folder)
    with closing(Engine(scenario)) as engine, closing(TopView(engine.backend.scenario)) as view:
        engine.reset([world_keys(_SEED)[0]])
        picture = Image.fromarray(view.draw(engine)).quantize(COLOURS, kmeans=REFINED, dither=Image.Dither.NONE)
    with replacing_file(folder / f"{name}.png") as path:
        picture.save(path, optimize=True)
    replace_text(folder / f"{name}.md", text)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; lines within a cell come one after the other, with semicolons between."""
    cells = ([plain("; ".join(text.splitlines())).replace("|", "\\|") for text in row] for row in (columns, *rows))
    heading, *lines = (f"| {' | '.join(row)} |" for row in cells)
    return "\n".join([heading, "|---" * len(columns) + "|", *lines])


def bullets(lines: Iterable[str]) -> str:
    """Return a list."""
    return "\n".join(f"- {plain(line)}" for line in lines)


def plain(text: str) -> str:
    """Return a text on one line, without what would be read as a tag."""
    return " ".join(text.split()).replace("<", "&lt;")


GLANCE = ("Vehicles", "Targets", "Camera", "Odometry", "V2X", "Observer", "Rates")
"""Facts that no table below repeats."""
MOST_ROWS = 40
"""Most rows of a table of vehicles, routes, landmarks or buildings."""
SHOWN_ELSEWHERE = {"observation.include", "observation.scales", "observation.centers", "reward.privileged"}
"""Settings that other tables show, as they show the weights."""


def _head(name: str, scenario: Scenario, films: Iterable[str]) -> Iterator[str]:
    yield f"# {plain(scenario.title)}"
    for text in (scenario.description, scenario.source and f"Source: {scenario.source}"):
        if text:
            yield plain(text)
    yield f"![Top view of {name}]({name}.png)"
    yield "At the start of the episode of seed 0: true vehicles filled, estimates in outline."
    yield from films
    known_facts = facts(scenario)
    yield table(("", ""), [(subject, known_facts[subject]) for subject in GLANCE])


def _scene(scenario: Scenario) -> Iterator[str]:
    yield "## Drawn at every reset"
    yield bullets(drawn(scenario)) or "Nothing: episodes differ in their noise only."
    if lines := list(graded(scenario)):
        yield f"With the difficulty (here {number(scenario.difficulty.number)}; [draws](../draws.md)):"
        yield bullets(lines)
    for listing in scenario_text.scene(scenario, grouped=False):
        yield f"## {listing.title}"
        rows = list(listing.rows)
        if len(rows) > MOST_ROWS:
            rows[MOST_ROWS:] = [(f"{len(rows) - MOST_ROWS} more", *[""] * (len(listing.columns) - 1))]
        yield table(listing.columns, rows)
    yield "## Settings"
    yield "Those that differ from the default."
    rows = [
        (f"`{section}.{key}`", value, meaning)
        for section in shown_sections(scenario)
        for key, value, meaning, differs in scenario_text.settings(getattr(scenario, section))
        if differs and f"{section}.{key}" not in SHOWN_ELSEWHERE and not key.startswith("weights.")
    ]
    yield table(("key", "value", "meaning"), rows)


def _learning(scenario: Scenario) -> Iterator[str]:
    layout = observation_layout(scenario)
    yield "## Observation"
    yield f"{layout.size} entries per vehicle; each is (value - center) / scale, clipped to [low, 1]."
    rows = [
        (f.group, f"`{name}`", "x".join(map(str, f.shape)), f.unit, *map(number, (f.center, f.scale, f.low)), f.meaning)
        for name, f in layout.items()
    ]
    yield table(("group", "field", "size", "unit", "center", "scale", "low", "meaning"), rows)
    if scenario.driven:
        yield "## Action"
        driven = next(i for i, vehicle in enumerate(scenario.vehicles) if vehicle.motion.kind == "driven")
        yield f"Ranges of the entries, for `{scenario.vehicle_names[driven]}`, the first driven vehicle."
        yield table(
            ("entry", "at -1", "at 1", "unit"),
            [(entry.name, number(entry.low), number(entry.high), entry.unit) for entry in layout.actions[driven]],
        )
    yield "## Reward"
    terms = REWARD_TERMS.known(scenario.reward.custom)
    weights = {name: weight for name, weight in scenario.reward.by_name.items() if weight}
    privileged = {name: " (privileged)" if terms[name].privileged else "" for name in weights}
    rows = [
        (f"`{name}`", number(weight), terms[name].unit, terms[name].meaning + privileged[name])
        for name, weight in weights.items()
    ]
    yield table(("term", "weight", "unit", "meaning"), rows) if rows else "None: every weight is 0."
    yield "## Termination"
    yield bullets(_endings(scenario))


def _endings(scenario: Scenario) -> Iterator[str]:
    steps, end = round(scenario.horizon * scenario.rates.decision), scenario.termination
    yield f"all vehicles after {number(scenario.horizon)} s, {steps} decisions"
    known = TERMINATION_CONDITIONS.known(end.custom)
    causes = [name for name in ("collision", "arrival") if scenario.driven and getattr(end, name)]
    for name in (*causes, *end.own):
        yield f"`{name}`: {known[name].meaning}"
    if end.off_route:
        yield f"`off_route`: being farther than {number(end.off_route)} m from its route, or beyond an end of it"
    if scenario.driven and end.arrival:
        after = {"park": "stands there", "leave": "is removed from the next camera tick on"}
        yield f"a vehicle that has arrived {after.get(end.after_arrival, 'draws a new route and continues')}"


def _end(name: str, measured: str) -> Iterator[str]:
    if measured:
        yield measured
    yield "## To try it"
    yield f"```\ncoopenv describe {name} --all\ncoopenv run {name} --seed 0\n```"
    if name in list_envs():
        file = f"[`envs/{name}.toml`](../../envs/{name}.toml)"
        yield f"Gymnasium and PettingZoo: `{environment_id(name)}`. Made by `coopenv page {name}` from {file}."


def index_text(scenarios: dict[str, Scenario]) -> str:
    """Return the page that lists environments, each with a page beside it."""
    columns = ("title", "vehicles", "landmarks", "motion", "horizon_s")
    rows = [
        (f"[`{row['name']}`]({row['name']}.md)", *(cell_text(row[key]) for key in columns))
        for row in environment_rows(scenarios)
    ]
    lines = [
        "# Environments",
        "One page per file of `envs/`, written by `coopenv page --all --out docs/environments` (`make pages`).",
        table(("environment", "title", "vehicles", "landmarks", "motion", "horizon [s]"), rows),
    ]
    return "\n\n".join(lines) + "\n"
