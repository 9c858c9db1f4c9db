"""Drivers on the same held-out worlds, and their figures on cards: JSON for programs, Markdown for people."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from coopenv.api.engine import Engine
from coopenv.base.columns import WIDTH, Columns, Tabular, one_line, picture_html, terminal_html
from coopenv.base.errors import ActionError, CoopenvError, check_one_of
from coopenv.base.files import check_file, replace_text
from coopenv.base.format import NONE, json_text
from coopenv.base.installation import is_installed, load_reference, version
from coopenv.base.seeds import checked_seed
from coopenv.base.terminal import text_of
from coopenv.evaluation import METRICS, Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.evaluation.metrics import LOSSES, LOST, SCORE, ranking_key
from coopenv.policies import Agent, Policy, agents_for, find_agent
from coopenv.policies.loader import CARD_FILES
from coopenv.runs.console import number_table
from coopenv.scenario import Scenario, ScenarioLike, scenario_name
from coopenv.sources.sources import open_simulation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BASELINE, IDEAL = "route_follower", "ideal_sensing"
"""Reference of all comparisons, and the name of the same driver under ideal sensing."""
IDEAL_SENSING: Mapping[str, Any] = {"sensing": "ideal"}


OF_MESSAGES: dict[str, dict[str, Any]] = {
    "60 % of messages lost": {"v2x.loss": 0.6},
    "vehicle_1 lies": {"vehicles.0.faults.lie": {"kind": "jump", "start": 2.0, "offset": 3.0}},
}


BACK = 1.2
"""Factor by which landmarks are set back from the origin."""


def stress(scenario: Scenario) -> dict[str, dict[str, Any]]:
    """Return overrides for worlds that are harder or easier to sense than a scenario's, by what is changed."""
    noise, camera = scenario.noise, scenario.camera
    lenses = (0.6, 1.5) if camera.model == "pinhole" else ()
    boxes = {f"landmark_groups.{i}.boxes": group.boxes for i, group in enumerate(scenario.landmark_groups)}
    back = {key: [{"center": [BACK * x for x in b.center], "half": b.half} for b in own] for key, own in boxes.items()}
    one = {
        key: [b for b in own if all(x * y >= 0 for x, y in zip(b.center, own[0].center, strict=True))]
        for key, own in boxes.items()
    }
    corner = {key: [b.model_dump() for b in own] for key, own in one.items() if len(own) < len(boxes[key])}
    return {
        "ideal sensing": dict(IDEAL_SENSING),
        "all-round cameras": {"camera.model": "omnidirectional"},
        "twice the range": {"randomisation.camera_range": [2.0, 2.0]},
        "3/4 of the range": {"randomisation.camera_range": [0.75, 0.75]},
        "half of the landmarks": {"randomisation.landmark_presence": [0.5, 0.5]},
        "a third of the landmarks": {"randomisation.landmark_presence": [0.333, 0.333]},
        "bearing noise x 5": {"noise.bearing.scale": 5.0 * noise.bearing.scale},
        "odometry noise x 4": {
            "noise.velocity": 4.0 * noise.velocity,
            "noise.angular_velocity": 4.0 * noise.angular_velocity,
            "noise.odometry_scale": 0.03,
            "noise.gyro_bias": [0.0, 0.0, 0.0087],
        },
        **{f"initial error x {by:g}": {"randomisation.initial_error": [by, by]} for by in (2.0, 3.0)},
        **{f"focal length x {by:g}": {"camera.focal_length": [by * f for f in camera.focal_length]} for by in lenses},
        "mounting error 2 deg": {"camera.extrinsics_error": math.radians(2.0)},
        **({f"landmarks {BACK:g} x as far out": back} if any(back.values()) else {}),
        **({"landmarks in one corner": corner} if corner else {}),
        **(OF_MESSAGES if len(scenario.vehicles) > 1 else {}),
    }


KINDS = {
    "error_along_the_way": "coopenv.bench.evaluate:error_figure",
    "time_against_error": "coopenv.bench.evaluate:pareto_figure",
    "looking": "coopenv.bench.evaluate:looking_figure",
}
"""Functions that draw the figures of an evaluation, loaded when drawn: their module imports this one."""


@dataclass(frozen=True)
class Entrant:
    """A driver, and the world it drives in."""

    agent: Agent
    name: str
    kind: str
    scenario: Scenario
    policy: Policy


@dataclass(frozen=True, eq=False)
class Contest:
    """Drivers, and the held-out worlds that each of them drives in."""

    environment: str
    overrides: Mapping[str, Any]
    """Dotted keys of the scenario."""
    entrants: tuple[Entrant, ...]
    worlds: int
    block: int
    """Number of the block of held-out seeds."""

    @classmethod
    def of(
        cls,
        environment: ScenarioLike,
        overrides: Mapping[str, Any],
        agents: Sequence[str | Callable[..., Any]],
        worlds: int,
        block: int = 0,
        ideal: bool = False,
        stressed: bool = False,
    ) -> "Contest":
        """Build the drivers.

        Args:
            environment: as for `load_scenario`.
            overrides: dotted keys of the scenario.
            agents: agents as for `find_agent`; none: every shipped driver that was made for the environment.
            worlds: number of worlds.
            block: number of the block of held-out seeds.
            ideal: let the baseline drive under ideal sensing, too.
            stressed: let the drivers drive in the worlds of `stress`, too.

        Raises:
            CoopenvError: an agent does not exist or cannot drive here, two have one name, or nothing is driven here.
        """
        worlds, block = checked_seed(worlds, "worlds"), checked_seed(block, "seed_block")
        if worlds < 1:
            raise CoopenvError(f"worlds must be at least 1, got {worlds}")
        scenario, name = open_simulation(environment, overrides), scenario_name(environment)
        if not any(scenario.acting):
            why = "every driven vehicle has a driver" if scenario.driven else "all motion here is prescribed"
            raise CoopenvError(f"{name}: {why}, there is nothing to drive")
        found = [find_agent(text) for text in agents or agents_for(name)]
        if not found:
            raise CoopenvError(f"no agent of agents/ was made for {name}; name some with --agents A,B")
        entrants = [Entrant(agent, agent.name, agent.kind, scenario, agent.policy(scenario)) for agent in found]
        for row, changed in stress(scenario).items() if stressed else ():
            other = open_simulation(environment, {**overrides, **changed})
            entrants += [Entrant(a, f"{a.name}, {row}", a.kind, other, a.policy(other)) for a in found]
        names = [entrant.name for entrant in entrants]
        for twice in (word for word in names if names.count(word) > 1 or (ideal and word == IDEAL)):
            raise CoopenvError(f"agents: two are called '{twice}'")
        if ideal:
            agent, seeing = find_agent(BASELINE), open_simulation(environment, {**overrides, **IDEAL_SENSING})
            entrants.append(Entrant(agent, IDEAL, "reference", seeing, agent.policy(seeing)))
        return cls(name, overrides, tuple(entrants), worlds, block)

    def drive(self, on_progress: Callable[[float, str], None] = lambda done, name: None) -> "Evaluation":
        """Let every driver drive an episode in each of the same worlds.

        `on_progress` is called with the number of drivers that are done, shares included, and the driver's name.
        """
        seeds, episodes = held_out_seeds(self.block, self.worlds), dict[str, Episodes]()
        for _, group in groupby(enumerate(self.entrants), lambda row: id(row[1].scenario)):
            here = list(group)
            with closing(Engine(here[0][1].scenario, self.worlds)) as engine:
                engine.load()
                for place, entrant in here:

                    def report(share: float, place: int = place, name: str = entrant.name) -> None:
                        on_progress(place + share, name)

                    try:
                        episodes[entrant.name] = drive(engine, entrant.policy, seeds, report)
                    except ActionError as error:
                        raise ActionError(f"agent {entrant.name}: {error}") from error
        return Evaluation(**vars(self), episodes=episodes)


@dataclass(frozen=True, eq=False)
class Evaluation(Contest, Tabular):
    """Episodes and figures of drivers, by name; printed, it is its tables.

    As a table it has a row per driver and metric: `to_pandas`, `to_polars`, `to_xarray`, `to_csv` and `to_parquet`.
    """

    _PARTS = "episodes"
    episodes: Mapping[str, Episodes]

    @cached_property
    def results(self) -> dict[str, list[Result]]:
        """The figures of every driver."""
        return {name: score(own, self.block) for name, own in self.episodes.items()}

    @property
    def reference(self) -> str:
        """Driver that the differences are to."""
        return BASELINE if BASELINE in self.episodes else self.entrants[0].name

    @cached_property
    def differences(self) -> dict[str, list[Difference]]:
        """The differences of all other drivers to the reference."""
        base, others = self.episodes[self.reference], {**self.episodes}
        del others[self.reference]
        return {name: compare_paired(own, base, self.block) for name, own in others.items()}

    @property
    def ranking(self) -> list[str]:
        """The drivers of the environment as it is, the best first, see `coopenv.evaluation.ranking_key`."""
        here = [each.name for each in self.entrants if each.scenario is self.entrants[0].scenario]
        return sorted(here, key=lambda name: ranking_key({r.metric: r.mean for r in self.results[name]}))

    def __getitem__(self, driver: str) -> list[Result]:
        """Return the figures of one driver. Raises CoopenvError: it was not evaluated."""
        check_one_of("unknown driver", driver, self.results)
        return self.results[driver]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """One flat row per driver and metric."""
        return [
            {"agent": entrant.name, "kind": entrant.kind, "environment": self.environment, **asdict(result)}
            for entrant in self.entrants
            for result in self.results[entrant.name]
        ]

    def columns(self) -> Columns:
        """Return `rows`, the figures in the column `unit`."""
        rows = [{**row, "unit": METRICS[row["metric"]].unit} for row in self.rows]
        return Columns(
            {name: [row[name] for row in rows] for name in rows[0]}, ("agent", "metric"), ("mean", "ci_low", "ci_high")
        )

    def __repr__(self) -> str:
        return one_line(self, self.environment, {"agents": tuple(self.episodes), "worlds": self.worlds})

    def figure(
        self,
        kind: str = "time_against_error",
        *,
        width: str | float | None = None,
        path: str | Path | None = None,
        format: str | None = None,
    ) -> "Figure":
        """Draw a figure, and write it where a path is given; width, path, format and errors as of `Comparison.figure`.

        `kind` is "error_along_the_way", "time_against_error" or "looking".
        """
        from coopenv.viz import figures, style

        check_one_of("unknown figure", kind, KINDS)
        drawn: Figure = load_reference(KINDS[kind])(self, figures.inches_of(width))
        if isinstance(width, str):
            figures.restyle(drawn, width)
        if path is not None:
            about = {"environment": self.environment, "worlds": self.worlds, "block": self.block}
            style.save(drawn, Path(path), format or "", about={**about, "agents": ", ".join(self.episodes)})
        return drawn

    def _repr_html_(self) -> str:
        return terminal_html(self) + picture_html(self.figure())

    def __str__(self) -> str:
        return text_of(self, WIDTH)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield f"{self.environment}: {self.worlds} held-out worlds, block {self.block} of the seeds, the same for all."
        yield ""
        yield _results_table(self)
        if self.differences:
            yield ""
            yield _differences_table(self)
        yield ""
        yield "\n".join(f"{words}: {meaning}." for words, meaning in EXPLANATIONS.items())
        yield f"ranking: {', '.join(self.ranking)}."
        for name in self.ranking:
            e = self.episodes[name]
            pairs = [(e.vehicles[i], e.vehicles[j], e.seen_share[i, j]) for i, j in np.argwhere(e.seen_share >= 0.01)]
            if pairs:
                words = ", ".join(f"{own} measures {other} {share:.0%}" for own, other, share in pairs)
                yield f"{name}, share of the time under way: {words}."

    @cached_property
    def difference_rows(self) -> list[dict[str, Any]]:
        """One flat row per driver that was compared with the reference, and metric."""
        return [
            {"agent": name, "reference": self.reference, "environment": self.environment, **asdict(difference)}
            for name, differences in self.differences.items()
            for difference in differences
        ]


COLUMNS = {
    "arrival_rate": ("arrived\n[%]", 100.0),
    "collision_rate": ("collided\n[%]", 100.0),
    "travel_time_s": ("travel\n[s]", 1.0),
    "e50_m": ("e50\n[cm]", 100.0),
    "e95_m": ("e95\n[cm]", 100.0),
    "orientation_e95_deg": ("e95\n[deg]", 1.0),
    "few_targets_share": ("few\n[%]", 100.0),
    "return": ("return\n", 1.0),
}
"""Metric, its heading, and the factor to the heading's unit."""
EXPLANATIONS = {
    "intervals": "95 %, bootstrap over worlds",
    "e50, e95": "median and 95th percentile of the error from 3 s on, of vehicles under way",
    "lost": f"collided or never arrived: {LOST:g} m for the rest of the way, more than which no error counts",
    "score": f"e95 [cm] of the fleet; rankings go by losses in steps of {100 * LOSSES:g} %, then by the score",
    "few": "share of the time from 3 s on with fewer than three targets in view",
    "return": "sum of the rewards of a vehicle",
}
"""Legend of the tables."""


def figures(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return results as cards hold them, by metric."""
    return {r.metric: {"mean": r.mean, "ci_low": r.ci_low, "ci_high": r.ci_high, "n": r.n} for r in results}


def changes(differences: Sequence[Difference], metrics: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return differences as shares of the other agent's figures, as cards hold them, by metric."""
    return {
        d.metric: {"relative": d.relative, "ci_low": d.relative_ci_low, "ci_high": d.relative_ci_high}
        for d in differences
        if d.metric in metrics
    }


def shown(found: Mapping[str, Any], factor: float, figure: str = "mean") -> tuple[str, str, str]:
    """Return a figure of a card and the ends of its interval, with the decimals that the interval's width needs.

    Args:
        found: as a card holds it, where null stands for no number.
        factor: to the unit that is shown.
        figure: key of the figure.
    """
    values = [float("nan") if found[key] is None else factor * found[key] for key in (figure, "ci_low", "ci_high")]
    width = values[2] - values[1]
    decimals = 1
    if np.isfinite(width) and width > 0.0:
        decimals = int(np.clip(-np.floor(np.log10(width)), 0, 2))
    first, second, third = (f"{v:z.{decimals}f}" if np.isfinite(v) else NONE for v in values)
    return first, second, third


def cell(result: Mapping[str, Any], factor: float) -> str:
    """Return a figure of a card with its interval in brackets."""
    mean, low, high = shown(result, factor)
    return NONE if mean == NONE else f"{mean} [{low}, {high}]"


def percent(change: Mapping[str, Any]) -> str:
    """Return a relative difference of a card and its interval, in percent."""
    mean, low, high = shown(change, 100.0, "relative")
    return f"{signed(mean)} [{low}, {high}] %"


def signed(text: str) -> str:
    """Return a number with its sign."""
    return text if text.startswith("-") else f"+{text}"


COMPARED = ("travel_time_s", "e50_m", "e95_m", "orientation_e95_deg")
"""Metrics of which the differences are printed."""


def _results_table(board: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = number_table(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in board.results.items():
        found = figures(results)
        table.add_row(name, *(_cell(*shown(found[metric], factor)) for metric, (_, factor) in COLUMNS.items()))
    return table


def _differences_table(board: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = number_table((f"against {board.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in board.differences.items():
        found = changes(differences, COMPARED)
        table.add_row(name, *(_cell(*map(signed, shown(found[metric], 100.0, "relative"))) for metric in COMPARED))
    return table


def _cell(mean: str, low: str, high: str) -> str:
    return mean if low == NONE else f"{mean}\n{low}..{high}"


CHANGES = {"e95_m": "e95", "e50_m": "e50", "travel_time_s": "travel time"}
"""Metrics whose changes stand on cards, and their names there."""


JSON_FILE, TEXT_FILE = CARD_FILES


def carded(contest: Contest) -> list[tuple[Entrant, Path]]:
    """Return the drivers that get a card, with their folders, each of which has a readable card or none.

    Raises:
        CoopenvError: an agent has no folder or one of the installed wheel, or its card cannot be read or written.
    """
    found = []
    for entrant in contest.entrants:
        folder = entrant.agent.folder
        if folder is None:
            raise CoopenvError(f"--write-card: {entrant.name} is a place in code; a card needs an agent's folder")
        if is_installed(folder):
            why = f"{entrant.name} belongs to the installation; copy {folder} and name the copy in --agents"
            raise CoopenvError(f"--write-card: {why}")
        if entrant.name != IDEAL:
            read(folder)
            for name in CARD_FILES:
                check_file(folder / name)
            found.append((entrant, folder))
    return found


def read(folder: Path) -> dict[str, Any]:
    """Return the contents of `card.json`, results by environment under `environments`; without a card, no results.

    Raises:
        CoopenvError: `card.json` is not one.
    """
    path = folder / JSON_FILE
    if not path.exists():
        return {"environments": {}}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return {**document, "environments": dict(document["environments"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CoopenvError(f"{path}: not a card: {error}") from None


def write(evaluation: Evaluation, cards: Iterable[tuple[Entrant, Path]], command: str) -> list[Path]:
    """Write the results of an evaluation to cards, see `carded`; results of other environments stay."""
    written = []
    for entrant, folder in cards:
        card = read(folder)
        known = card["environments"]
        results = figures(evaluation.results[entrant.name])
        known[evaluation.environment] = measured(command, evaluation.worlds, evaluation.block, results)
        card |= {"agent": entrant.name, "kind": entrant.kind, "environments": dict(sorted(known.items()))}
        written.append(save(folder, entrant.agent.description, card))
    return written


def measured(command: str, worlds: int, block: int, results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of an environment in a card."""
    about = {"command": command, "coopenv": version(), "score": SCORE, "worlds": worlds, "seed_block": block}
    return {**about, "results": results}


def save(folder: Path, description: str, card: Mapping[str, Any]) -> Path:
    """Write a card to an agent's folder, and return the path of the one for people."""
    replace_text(folder / JSON_FILE, json_text(card))
    old = any(entry.get("score", 1) < SCORE for entry in card["environments"].values())
    text = rendered("card.md.j2", card={"study": None, **card}, old=old, description=" ".join(description.split()))
    replace_text(folder / TEXT_FILE, text)
    return folder / TEXT_FILE


OVERVIEW = ("arrival_rate", "collision_rate", "travel_time_s", "e50_m", "e95_m")
WITHIN = 0.15
"""Seeds whose e95 is at most so much above the best one's count as alike."""


def seeds_of(card: Mapping[str, Any], metric: str) -> list[float]:
    """Return a figure of every seed of a study."""
    return [entry["results"][metric]["mean"] for entry in card["study"]["seeds"].values()]


def medians(card: Mapping[str, Any], base: Mapping[str, Any]) -> str:
    """Return the difference between the errors of the median seeds of two studies, in words."""
    shares = {m: median(seeds_of(card, m)) / median(seeds_of(base, m)) - 1 for m in ("e50_m", "e95_m")}
    return ", ".join(f"{CHANGES[metric]} {100 * share:+.0f} %" for metric, share in shares.items())


def headings(metrics: Iterable[str] | None) -> list[str]:
    """Return the headings of metrics (None: all) on one line each."""
    return [COLUMNS[metric][0].strip().replace("\n", " ") for metric in metrics or COLUMNS]


def cells(results: Mapping[str, Any], metrics: Iterable[str] = COLUMNS) -> str:
    """Return the figures of a card as cells of a row in Markdown."""
    return " | ".join(cell(results[metric], COLUMNS[metric][1]) for metric in metrics)


def rendered(template: str, **values: Any) -> str:
    """Return a text of `coopenv/bench/text`, in Markdown."""
    texts = Environment(
        loader=PackageLoader("coopenv.bench", "text"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    texts.globals |= {"headings": headings, "cells": cells, "percent": percent, "seeds_of": seeds_of}
    texts.globals |= {"medians": medians, "overview": OVERVIEW, "explanations": EXPLANATIONS, "within": WITHIN}
    texts.globals["changes"] = lambda found, metrics: ", ".join(f"{CHANGES[m]} {percent(found[m])}" for m in metrics)
    return texts.get_template(template).render(values)
