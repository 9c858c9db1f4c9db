"""`coopenv bench learning`: run the missing trainings of a study, side by side, and write a card after each."""

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache, partial
from itertools import compress, groupby, product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tomlkit
from pydantic import Field
from rich.console import Console
from rich.table import Table

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, check_one_of, listed
from coopenv.base.files import replace_text
from coopenv.base.sections import Section, read_toml, validated
from coopenv.bench import cards
from coopenv.bench.executors import Local
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.policies.loader import AGENT_FILE, CHECKPOINT_FILE, read_card
from coopenv.runs.console import Progress, number_table
from coopenv.sources.sources import open_simulation
from coopenv.training.settings import SETTINGS_FILE, TrainingPlan, read_settings

Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]


class StudyFile(Section):
    """The contents of a study's TOML file."""

    settings: str
    """TOML file of `coopenv train`, beside this one, with a table under `arms` for each arm."""
    environments: tuple[Name, ...] = Field(min_length=1)
    arms: tuple[Name, ...] = Field(min_length=1)
    seeds: tuple[Seed, ...] = Field(min_length=1)
    treatment: tuple[str, ...] = ("scenario.reward.*",)
    """Patterns of the settings in which the arms may differ."""


def agent_of(plan: TrainingPlan) -> str:
    """Return the name of the agent of all trainings that differ in their seed alone."""
    return f"{plan.environment}_{plan.arm}"


def place_of(plan: TrainingPlan) -> Path:
    """Return the path of a training's agent in the study's folder."""
    return Path(agent_of(plan), f"seed_{plan.seed}")


@dataclass(frozen=True)
class Study:
    """Trainings of a study."""

    plans: tuple[TrainingPlan, ...]
    """All trainings; every agent's first one before any agent's second."""

    @property
    def agents(self) -> dict[str, list[TrainingPlan]]:
        """The trainings of every agent."""
        found: dict[str, list[TrainingPlan]] = {}
        for plan in self.plans:
            found.setdefault(agent_of(plan), []).append(plan)
        return found

    def only(self, words: Sequence[str]) -> "Study":
        """Return the part of the study that names of environments and arms and numbers of seeds choose.

        Raises:
            CoopenvError: it has nothing of such a name.
        """
        keys = [(plan.environment, str(plan.arm), str(plan.seed)) for plan in self.plans]
        names = [set(column) for column in zip(*keys, strict=True)]
        known = set().union(*names)
        for word in words:
            check_one_of("--only: the study has no", word, sorted(known))
        chosen = [{*words} & column or column for column in names]
        fits = [all(word in column for word, column in zip(key, chosen, strict=True)) for key in keys]
        return Study(tuple(compress(self.plans, fits)))


def read_study(path: Path) -> Study:
    """Read a study and the settings that it names.

    Raises:
        CoopenvError: one of the files is not valid, or arms differ in more than their treatment; one line that names
            file and field.
    """
    file = validated(StudyFile, read_toml(path), str(path))
    groups = list(product(file.environments, file.arms))
    settings = [read_settings(path.parent / file.settings, arm, environment) for environment, arm in groups]
    pairs = list(zip(groups, settings, strict=True))
    for place, rows in groupby(pairs, lambda pair: pair[0][0]):
        (first, base), *others = [(arm, _flat(own.model_dump(mode="json"))) for (_, arm), own in rows]
        for arm, own in others:
            changed = (key for key in sorted({*base, *own}) if base.get(key) != own.get(key))
            if extra := [key for key in changed if not any(fnmatchcase(key, pattern) for pattern in file.treatment)]:
                stated = f"in more than the treatment ({listed(file.treatment)})"
                raise CoopenvError(f"{path}: arms {first} and {arm} differ in {place} {stated}: {listed(extra, 8)}")
    return Study(tuple(TrainingPlan(place, own, seed, arm) for seed in file.seeds for (place, arm), own in pairs))


def _flat(tables: Mapping[str, Any], name: str = "") -> dict[str, Any]:
    """Return the values of tables within tables by their dotted keys."""
    found: dict[str, Any] = {}
    for key, value in tables.items():
        found |= _flat(value, f"{name}{key}.") if isinstance(value, dict) else {f"{name}{key}": value}
    return found


def is_finished(plan: TrainingPlan, folder: Path) -> bool:
    """Return whether a training's agent is there, trained as in the present study and environment."""
    from coopenv.training.export import scenario_digest  # needs the extra `train`

    place = folder / place_of(plan)
    if not (place / AGENT_FILE).is_file() or not (place / SETTINGS_FILE).is_file():
        return False
    try:
        card, settings = read_card(place), read_settings(place / SETTINGS_FILE)
    except (CoopenvError, tomllib.TOMLDecodeError):
        return False
    known = [card.training.get(key) for key in ("environment", "seed", "arm", "scenario")]
    scenario = scenario_digest(open_simulation(plan.environment, plan.all_overrides))
    return known == [plan.environment, plan.seed, plan.arm, scenario] and settings == plan.settings


def unfinished(study: Study, folder: Path) -> list[TrainingPlan]:
    """Return the trainings of a study that are not finished.

    Raises:
        CoopenvError: one of them is not possible; it is found before the others run.
    """
    from coopenv.training.command import possible  # needs the extra `train`

    plans = [plan for plan in study.plans if not is_finished(plan, folder)]
    for plan in plans:
        try:
            possible(plan)
        except CoopenvError as error:
            raise CoopenvError(f"{place_of(plan)}: {error}") from None
    return plans


def perform(folder: Path, logs: Path, plan: TrainingPlan) -> None:
    """Train on one core, going on from a checkpoint where there is one of the same training.

    An agent that is there has been trained with other settings, and is replaced.

    Raises:
        CoopenvError: errors of `train`.
    """
    from coopenv.training.command import read, train  # needs the extra `train`

    out, own_logs = folder / place_of(plan), logs / place_of(plan)
    path = out / CHECKPOINT_FILE
    resume = path.is_file() and read(path).plan == plan
    if not resume:
        path.unlink(missing_ok=True)  # of a training with other settings
    own_logs.mkdir(parents=True, exist_ok=True)
    train(plan, out, resume=resume, threads=1, logs=own_logs, force=True)


REPORTED, CHOSEN = 0, 1
"""Blocks of held-out seeds: figures on cards are of the first; which seed is the best is decided in the second."""


class Driven(NamedTuple):
    """Inputs that determine the episodes."""

    environment: str
    agent: str
    overrides: str
    """Overrides as JSON."""
    block: int
    weights: tuple[int, ...]
    """Modification times of the weights: retrained weights are another agent."""


class Judge:
    """Drives agents in the same worlds, and stores the results: figures, and one environment's episodes."""

    def __init__(self, worlds: int) -> None:
        """Take so many worlds of either block."""
        self.worlds = worlds
        self._episodes: dict[Driven, Episodes] = {}
        self._score = cache(lambda driven: score(self._drive(driven)))
        self._compare = cache(lambda own, other: compare_paired(self._drive(own), self._drive(other)))

    def results(
        self, environment: str, agent: str | Path, overrides: Mapping[str, Any] | None = None, block: int = REPORTED
    ) -> list[Result]:
        """Return the figures of an agent in the worlds of a block, under overrides of the environment."""
        return self._score(_driven(environment, agent, overrides or {}, block))

    def against(self, environment: str, agent: str | Path, other: str | Path) -> list[Difference]:
        """Return the differences between two agents' figures in the same worlds."""
        return self._compare(*(_driven(environment, each, {}, REPORTED) for each in (agent, other)))

    def merit(self, environment: str, agent: Path, overrides: Mapping[str, Any]) -> float:
        """Return the mean return of an agent by the reward that it learnt from, in worlds of the other block."""
        results = self.results(environment, agent, overrides, CHOSEN)
        return {result.metric: result.mean for result in results}["return"]

    def _drive(self, driven: Driven) -> Episodes:
        """Return episodes; large ones stay only as long as others of their environment are wanted for comparison."""
        if any(other.environment != driven.environment for other in self._episodes):
            self._episodes.clear()
        if driven in self._episodes:
            return self._episodes[driven]
        scenario = open_simulation(driven.environment, json.loads(driven.overrides))
        with closing(Engine(scenario, self.worlds)) as engine:
            found = drive(engine, load_agent(driven.agent, scenario), held_out_seeds(driven.block, self.worlds))
        if driven.block == REPORTED:
            self._episodes[driven] = found
        return found


def _driven(environment: str, agent: str | Path, overrides: Mapping[str, Any], block: int) -> Driven:
    weights = sorted(path.stat().st_mtime_ns for path in Path(agent).glob("*.safetensors"))
    return Driven(environment, str(agent), json.dumps(overrides, sort_keys=True), block, tuple(weights))


BASELINES = ("route_follower", "peek", "look_ahead")
PAGE_FILE = "README.md"
BASE_ARM = "plain"
"""The arm that others are compared with."""


def is_reported(agent: str, plans: Sequence[TrainingPlan], folder: Path) -> bool:
    """Return whether an agent has a card of exactly these finished runs."""
    seeds = cards.read(folder / agent).get("study", {}).get("seeds", {})
    found = {int(seed): entry["runs"]["sha256"] for seed, entry in seeds.items()}
    return found == {plan.seed: _trained(folder / place_of(plan))["sha256"] for plan in plans}


def _trained(place: Path) -> dict[str, Any]:
    """Return the training of an agent, from its folder."""
    document = tomllib.loads((place / AGENT_FILE).read_text(encoding="utf-8"))
    training = document["training"]
    found = {key: training[key] for key in ("steps", "cpu_minutes", "command")}
    return {"sha256": document["network"]["sha256"], **found}


def write_card(finished: Sequence[TrainingPlan], folder: Path, judge: Judge) -> None:
    """Write an agent of which some runs are finished, and its card.

    Which seed is the best is decided by the return that it learnt from, in held-out worlds of their own.
    """
    environment, place = finished[0].environment, folder / agent_of(finished[0])
    agents = {plan.seed: folder / place_of(plan) for plan in finished}
    overrides = finished[0].settings.scenario
    merits = {seed: judge.merit(environment, agent, overrides) for seed, agent in agents.items()}
    best = max(merits, key=lambda seed: merits[seed])
    results = {seed: cards.figures(judge.results(environment, agent)) for seed, agent in agents.items()}
    description = _write_agent(place, agents[best].name, finished)
    against = {name: judge.against(environment, agents[best], name) for name in BASELINES}
    beside = {name: judge.results(environment, name) for name in BASELINES}
    beside[cards.IDEAL] = judge.results(environment, BASELINES[0], cards.IDEAL_SENSING)
    driven = ",".join(map(str, (*agents.values(), *BASELINES)))
    command = (
        f"coopenv evaluate {environment} --agents {driven} --worlds {judge.worlds} --seed-block {REPORTED} --ideal"
    )
    study = {
        "arm": finished[0].arm,
        "best": best,
        "seeds": {
            str(seed): {"runs": _trained(agent), "merit": merits[seed], "results": results[seed]}
            for seed, agent in agents.items()
        },
        "beside": {name: cards.figures(found) for name, found in beside.items()},
        "against": {name: cards.changes(found, cards.OVERVIEW) for name, found in against.items()},
    }
    entry = cards.measured(command, judge.worlds, REPORTED, results[best])
    card = {"agent": place.name, "kind": "learned", "environments": {environment: entry}, "study": study}
    cards.save(place, description, card)


def _write_agent(place: Path, best: str, finished: Sequence[TrainingPlan]) -> str:
    """Write the agent that drives as one seed of it does, with its settings, and return its description."""
    document = tomlkit.parse((place / best / AGENT_FILE).read_text(encoding="utf-8"))
    environment, arm = finished[0].environment, finished[0].arm
    names = ", ".join(str(seed) for seed in sorted(plan.seed for plan in finished))
    description = f"PPO in {environment}, arm {arm}: {best.replace('_', ' ')}, the best of {names}."
    document["title"], document["description"] = f"{environment}, {arm}", description
    document["network"]["weights"] = f"{best}/{document['network']['weights']}"
    replace_text(place / AGENT_FILE, tomlkit.dumps(document))
    replace_text(place / SETTINGS_FILE, (place / best / SETTINGS_FILE).read_text(encoding="utf-8"))
    return description


def write_overview(agents: Iterable[TrainingPlan], folder: Path, judge: Judge) -> None:
    """Write the page of agents that have a card, of each a training; others are to be trained anew."""
    sections = {}
    for environment, plans in groupby(agents, lambda plan: plan.environment):
        own = {agent_of(plan): plan.arm for plan in plans}
        found = {name: cards.read(folder / name) for name in own}
        best = {name: folder / name / f"seed_{card['study']['best']}" for name, card in found.items()}
        base = next((name for name, arm in own.items() if arm == BASE_ARM), None)
        others = [name for name in own if base is not None and name != base]
        against = {name: judge.against(environment, best[name], best[str(base)]) for name in others}
        relative = {name: cards.changes(found, cards.OVERVIEW) for name, found in against.items()}
        sections[environment] = {"cards": found, "base": base, "against": relative}
    replace_text(folder / PAGE_FILE, cards.rendered("agents.md.j2", sections=sections))


def run(study: Study, part: Study, folder: Path, logs: Path, jobs: int, worlds: int, log: Console) -> None:
    """Train every run of a part of a study that is not finished, and bring all cards up to date.

    Whatever ends it, going on is the same command: finished runs stay, others go on from their checkpoints.

    Args:
        study: the trainings that cards compare.
        part: the trainings to run now.
        folder: for the agents.
        logs: for TensorBoard's files.
        jobs: trainings side by side, of one core each.
        worlds: held-out ones per agent.
        log: console of the progress.

    Raises:
        CoopenvError: a training cannot be done.
        OutputError: something cannot be written.
    """
    judge, missing = Judge(worlds), unfinished(part, folder)
    total = len(part.plans)
    before = total - len(missing)
    folder.mkdir(parents=True, exist_ok=True)

    def judge_finished() -> None:
        of_agents = ([plan for plan in plans if is_finished(plan, folder)] for plans in study.agents.values())
        finished = [plans for plans in of_agents if plans]
        stale = [plans for plans in finished if not is_reported(agent_of(plans[0]), plans, folder)]
        for plans in stale:
            write_card(plans, folder, judge)
        if stale or not (folder / PAGE_FILE).exists():
            write_overview([plans[0] for plans in finished], folder, judge)

    with Progress(log, f"{before} of {total} trainings were done", total=len(missing) or None) as progress:

        def on_done(done: int) -> None:
            progress.update(done, f"{before + done} of {total} trainings are done")
            judge_finished()

        judge_finished()
        if missing:
            Local(jobs).map(partial(perform, folder, logs), missing, on_done)


def results_table(study: Study, folder: Path) -> Table:
    """Return one row per agent: the figures of its best seed, and how its seeds differ."""
    columns = {metric: cards.COLUMNS[metric] for metric in cards.OVERVIEW}
    headings = [*(heading for heading, _ in columns.values()), "e95 of\nseeds [cm]"]
    table = number_table(("agent", "seeds"), headings, gap=0)
    for agent, plans in study.agents.items():
        card = cards.read(folder / agent)
        if "study" not in card:
            continue
        results, errors = card["environments"][plans[0].environment]["results"], cards.seeds_of(card, "e95_m")
        figures = [cards.cell(results[m], factor).replace(" ", "\n", 1) for m, (_, factor) in columns.items()]
        table.add_row(agent, str(len(errors)), *figures, " ".join(f"{100 * error:.0f}" for error in errors))
    return table
