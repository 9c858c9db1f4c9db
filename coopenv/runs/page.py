"""The page of an environment, in Markdown, from its scenario."""

from collections.abc import Iterable, Iterator, Sequence

from coopenv.api.terms.layout import observation_layout
from coopenv.base.format import number
from coopenv.base.installation import environment_id, list_envs
from coopenv.runs import scenario_text
from coopenv.runs.scenario_text import drawn, graded
from coopenv.runs.summary import cell_text, environment_rows, facts, shown_sections
from coopenv.scenario import Scenario
from coopenv.scenario.terms import REWARD_TERMS, TERMINATION_CONDITIONS


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
TOLD = {"observation.include", "observation.scales", "observation.centers", "reward.privileged"}
"""Settings that other tables tell, as they tell the weights."""


def page_text(name: str, scenario: Scenario, measured: str = "", film: str = "") -> str:
    """Return the page of an environment.

    Args:
        name: of the environment and of the picture beside the page.
        scenario: the environment.
        measured: a part with measured figures, if there are any.
        film: caption of the film beside the page, if there is one; it has the name of the picture.
    """
    return (
        "\n\n".join([*_head(name, scenario, film), *_scene(scenario), *_learning(scenario), *_end(name, measured)])
        + "\n"
    )


def _head(name: str, scenario: Scenario, film: str) -> Iterator[str]:
    yield f"# {plain(scenario.title)}"
    for text in (scenario.description, scenario.source and f"Source: {scenario.source}"):
        if text:
            yield plain(text)
    yield f"![Top view of {name}]({name}.png)"
    yield "At the start of the episode of seed 0: true vehicles filled, estimates in outline."
    if film:
        yield f"![Film of {name}, from above]({name}.webp)"
        yield film
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
        yield table(listing.columns, listing.rows)
    yield "## Settings"
    yield "Those that differ from the default."
    rows = [
        (f"`{section}.{key}`", value, meaning)
        for section in shown_sections(scenario)
        for key, value, meaning, differs in scenario_text.settings(getattr(scenario, section))
        if differs and f"{section}.{key}" not in TOLD and not key.startswith("weights.")
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
