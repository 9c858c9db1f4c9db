"""The page of an environment: text, picture, film and measured figures; and the index of all pages."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path

from PIL import Image

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.base.files import check_file, replace_text, replacing_file, writing
from coopenv.base.format import number
from coopenv.base.installation import environment_id, list_envs
from coopenv.base.seeds import world_keys
from coopenv.report.table import Column, Table, bullets, markdown, plain
from coopenv.runs import scenario_text
from coopenv.runs.summary import environment_rows, facts, shown_sections
from coopenv.scenario import Scenario
from coopenv.scenario.terms import REWARD_TERMS, TERMINATION_CONDITIONS
from coopenv.viz.topview import TopView
from sitegen.environments.draws import drawn, graded
from sitegen.environments.films import SEED, films, write_page_films
from sitegen.environments.sensing import MADE_BY, read_value_of_sensing, value_of_sensing_text

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
        engine.reset([world_keys(SEED)[0]])
        picture = Image.fromarray(view.draw(engine)).quantize(COLOURS, kmeans=REFINED, dither=Image.Dither.NONE)
    with replacing_file(folder / f"{name}.png") as path:
        picture.save(path, optimize=True)
    replace_text(folder / f"{name}.md", text)


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
    yield markdown(("", ""), [(subject, known_facts[subject]) for subject in GLANCE])


def _scene(scenario: Scenario) -> Iterator[str]:
    yield "## Drawn at every reset"
    yield bullets(drawn(scenario)) or "Nothing: episodes differ in their noise only."
    if lines := list(graded(scenario)):
        yield f"With the difficulty (here {number(scenario.difficulty.number)}; [draws](../draws.md)):"
        yield bullets(lines)
    for listing in scenario_text.scene(scenario, grouped=False):
        yield f"## {listing.title}"
        rows = list(zip(*listing.cells, strict=True))
        if len(rows) > MOST_ROWS:
            rows[MOST_ROWS:] = [(f"{len(rows) - MOST_ROWS} more", *[""] * (len(listing.columns) - 1))]
        yield markdown(listing.headings, rows)
    yield "## Settings"
    yield "Those that differ from the default."
    rows = [
        (f"`{section}.{key}`", value, meaning)
        for section in shown_sections(scenario)
        for key, value, meaning, differs in scenario_text.settings(getattr(scenario, section))
        if differs and f"{section}.{key}" not in SHOWN_ELSEWHERE and not key.startswith("weights.")
    ]
    yield markdown(("key", "value", "meaning"), rows)


def _learning(scenario: Scenario) -> Iterator[str]:
    layout = observation_layout(scenario)
    yield "## Observation"
    yield f"{layout.size} entries per vehicle; each is (value - center) / scale, clipped to [low, 1]."
    rows = [
        (f.group, f"`{name}`", "x".join(map(str, f.shape)), f.unit, *map(number, (f.center, f.scale, f.low)), f.meaning)
        for name, f in layout.items()
    ]
    yield markdown(("group", "field", "size", "unit", "center", "scale", "low", "meaning"), rows)
    if scenario.driven:
        yield "## Action"
        driven = next(i for i, vehicle in enumerate(scenario.vehicles) if vehicle.motion.kind == "driven")
        yield f"Ranges of the entries, for `{scenario.vehicle_names[driven]}`, the first driven vehicle."
        yield markdown(
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
    yield markdown(("term", "weight", "unit", "meaning"), rows) if rows else "None: every weight is 0."
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
        yield f"Gymnasium and PettingZoo: `{environment_id(name)}`. Made by `{MADE_BY} {name}` from {file}."


def index_text(scenarios: dict[str, Scenario]) -> str:
    """Return the page that lists environments, each with a page beside it."""
    columns = (
        Column("name", "environment", write=lambda names: [f"[`{name}`]({name}.md)" for name in names]),
        *map(Column, ("title", "vehicles", "landmarks", "motion")),
        Column("horizon_s", "horizon [s]"),
    )
    lines = [
        "# Environments",
        f"One page per file of `envs/`, written by `{MADE_BY} --all --out docs/environments` (`make pages`).",
        Table.of(columns, environment_rows(scenarios)).markdown(),
    ]
    return "\n\n".join(lines) + "\n"
