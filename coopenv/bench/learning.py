"""`coopenv bench learning`: train what a study lacks, side by side, and write a card as each run ends."""

import json
import tomllib
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import tomlkit
from pydantic import Field
from rich.console import Console
from rich.table import Table

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.base.errors import CoopenvError, suggest
from coopenv.base.files import replace_text
from coopenv.base.sections import Section, read_toml, validated
from coopenv.bench import cards
from coopenv.bench.executors import Local
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.policies.loader import AGENT_FILE, CHECKPOINT_FILE, read_card
from coopenv.runs.console import Progress, number_table
from coopenv.training.settings import SETTINGS_FILE, Plan, Settings, read_settings

T = TypeVar("T")
Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]


class StudyFile(Section):
    """The contents of a study's TOML file."""

    settings: str
    """TOML file of `coopenv train`, beside this one, with a table under `arms` for each arm."""
    environments: tuple[Name, ...] = Field(min_length=1)
    arms: tuple[Name, ...] = Field(min_length=1)
    seeds: tuple[Seed, ...] = Field(min_length=1)


class Group(NamedTuple):
    """The runs that differ in nothing but their seed; one agent comes of them."""

    environment: str
    arm: str

    @property
    def name(self) -> str:
        """Of the agent and its folder."""
        return f"{self.environment}_{self.arm}"


@dataclass(frozen=True)
class Study:
    """What is to be trained."""

    settings: dict[Group, Settings]
    """Of every agent, by environment and then by arm."""
    seeds: tuple[int, ...]

    @property
    def plans(self) -> Iterator[Plan]:
        """All trainings; every agent's first one before any agent's second."""
        return (self.plan(group, seed) for seed in self.seeds for group in self.settings)

    def plan(self, group: Group, seed: int) -> Plan:
        """Return what exactly is trained for an agent with a seed."""
        return Plan(group.environment, self.settings[group], seed, group.arm)

    def only(self, words: Sequence[str]) -> "Study":
        """Return the part of the study that names of environments and arms and numbers of seeds choose.

        Raises:
            CoopenvError: it has nothing of such a name.
        """
        environments, arms = ({*names} for names in zip(*self.settings, strict=True))
        seeds = {str(seed): seed for seed in self.seeds}
        known = (*environments, *arms, *seeds)
        for word in words:
            if word not in known:
                known_names = f"{suggest(word, known)}; known: {', '.join(sorted(known))}"
                raise CoopenvError(f"--only: the study has no '{word}'{known_names}")
        chosen = [{*words} & {*names} or {*names} for names in (environments, arms, seeds)]
        kept = {g: s for g, s in self.settings.items() if g.environment in chosen[0] and g.arm in chosen[1]}
        return Study(kept, tuple(seed for text, seed in seeds.items() if text in chosen[2]))


def read_study(path: Path) -> Study:
    """Read a study and the settings that it names.

    Raises:
        CoopenvError: one of the files is not valid; one line that names file and field.
    """
    file = validated(StudyFile, read_toml(path), str(path))
    groups = [Group(environment, arm) for environment in file.environments for arm in file.arms]
    settings = {group: read_settings(path.parent / file.settings, group.arm, group.environment) for group in groups}
    return Study(settings, file.seeds)


def place_of(plan: Plan) -> Path:
    """Return where the agent of a training goes, in the study's folder."""
    return Path(Group(plan.environment, str(plan.arm)).name, f"seed_{plan.seed}")


def is_finished(plan: Plan, folder: Path) -> bool:
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


def unfinished(study: Study, folder: Path) -> list[Plan]:
    """Return the trainings of a study that are not finished.

    Raises:
        CoopenvError: one of them is not possible: better now than when the others have been waited for.
    """
    from coopenv.training.command import possible  # needs the extra `train`

    plans = [plan for plan in study.plans if not is_finished(plan, folder)]
    for plan in plans:
        try:
            possible(plan)
        except CoopenvError as error:
            raise CoopenvError(f"{place_of(plan)}: {error}") from None
    return plans


def perform(folder: Path, logs: Path, plan: Plan) -> None:
    """Train on one core, going on from a checkpoint where there is one of the same training.

    An agent that is there has been trained with other settings, and is replaced.

    Raises:
        CoopenvError: what `train` raises.
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
    """What episodes depend on."""

    environment: str
    agent: str
    overrides: str
    """As JSON."""
    block: int
    weights: tuple[int, ...]
    """When they were written: weights that are trained anew are another agent."""


class Judge:
    """Drives agents in the same worlds, and remembers what came of it: figures, and one environment's episodes."""

    def __init__(self, worlds: int) -> None:
        """Take so many worlds of either block."""
        self.worlds = worlds
        self._episodes: dict[Driven, Episodes] = {}
        self._known: dict[Hashable, Any] = {}

    def results(
        self, environment: str, agent: str | Path, overrides: Mapping[str, Any] | None = None, block: int = REPORTED
    ) -> list[Result]:
        """Return the figures of an agent in the worlds of a block, under overrides of the environment."""
        driven = _driven(environment, agent, overrides or {}, block)
        return self._once(driven, lambda: score(self._drive(driven)))

    def against(self, environment: str, agent: str | Path, other: str | Path) -> list[Difference]:
        """Return how much an agent's figures differ from another's in the same worlds."""
        pair = tuple(_driven(environment, each, {}, REPORTED) for each in (agent, other))
        return self._once(pair, lambda: compare_paired(*map(self._drive, pair)))

    def merit(self, environment: str, agent: Path, overrides: Mapping[str, Any]) -> float:
        """Return the mean return of an agent by the reward that it learnt from, in worlds of the other block."""
        results = self.results(environment, agent, overrides, CHOSEN)
        return {result.metric: result.mean for result in results}["return"]

    def _once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return what is known of a key, or make it."""
        if key not in self._known:
            self._known[key] = make()
        found: T = self._known[key]
        return found

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


def is_reported(group: Group, plans: Sequence[Plan], folder: Path) -> bool:
    """Return whether a group has a card that tells of just these finished runs."""
    seeds = cards.read(folder / group.name).get("study", {}).get("seeds", {})
    found = {int(seed): entry["runs"]["sha256"] for seed, entry in seeds.items()}
    return found == {plan.seed: _trained(folder / place_of(plan))["sha256"] for plan in plans}


def _trained(place: Path) -> dict[str, Any]:
    """Return the training of an agent, from its folder."""
    document = tomllib.loads((place / AGENT_FILE).read_text(encoding="utf-8"))
    training = document["training"]
    found = {key: training[key] for key in ("steps", "cpu_minutes", "command")}
    return {"sha256": document["network"]["sha256"], **found}


def write_card(group: Group, finished: Sequence[Plan], folder: Path, judge: Judge) -> None:
    """Write the agent and the card of a group of which some runs are finished.

    Which seed is the best is decided by the return that it learnt from, in held-out worlds of their own.
    """
    environment, place = group.environment, folder / group.name
    agents = {plan.seed: folder / place_of(plan) for plan in finished}
    overrides = finished[0].settings.scenario
    merits = {seed: judge.merit(environment, agent, overrides) for seed, agent in agents.items()}
    best = max(merits, key=lambda seed: merits[seed])
    results = {seed: cards.figures(judge.results(environment, agent)) for seed, agent in agents.items()}
    description = _write_agent(place, agents[best].name, group, sorted(agents))
    against = {name: judge.against(environment, agents[best], name) for name in BASELINES}
    beside = {name: judge.results(environment, name) for name in BASELINES}
    beside[cards.IDEAL] = judge.results(environment, BASELINES[0], cards.IDEAL_SENSING)
    driven = ",".join(map(str, (*agents.values(), *BASELINES)))
    command = (
        f"coopenv evaluate {environment} --agents {driven} --worlds {judge.worlds} --seed-block {REPORTED} --ideal"
    )
    study = {
        "arm": group.arm,
        "best": best,
        "seeds": {
            str(seed): {"runs": _trained(agent), "merit": merits[seed], "results": results[seed]}
            for seed, agent in agents.items()
        },
        "beside": {name: cards.figures(found) for name, found in beside.items()},
        "against": {name: cards.changes(found, cards.OVERVIEW) for name, found in against.items()},
    }
    entry = cards.measured(command, judge.worlds, REPORTED, results[best])
    card = {"agent": group.name, "kind": "learned", "environments": {environment: entry}, "study": study}
    cards.save(place, description, card)


def _write_agent(place: Path, best: str, group: Group, seeds: Sequence[int]) -> str:
    """Write the agent that drives as one seed of it does, with its settings, and return its description."""
    document = tomlkit.parse((place / best / AGENT_FILE).read_text(encoding="utf-8"))
    names = ", ".join(map(str, seeds))
    description = f"PPO in {group.environment}, arm {group.arm}: {best.replace('_', ' ')}, the best of {names}."
    document["title"], document["description"] = f"{group.environment}, {group.arm}", description
    document["network"]["weights"] = f"{best}/{document['network']['weights']}"
    replace_text(place / AGENT_FILE, tomlkit.dumps(document))
    replace_text(place / SETTINGS_FILE, (place / best / SETTINGS_FILE).read_text(encoding="utf-8"))
    return description


def write_overview(groups: Sequence[Group], folder: Path, judge: Judge) -> None:
    """Write the page of agents, each of which has a card; those that are to be trained anew are left out of it."""
    sections = {}
    for environment in dict.fromkeys(group.environment for group in groups):
        own = {group.name: group.arm for group in groups if group.environment == environment}
        found = {name: cards.read(folder / name) for name in own}
        best = {name: folder / name / f"seed_{card['study']['best']}" for name, card in found.items()}
        base = next((name for name, arm in own.items() if arm == BASE_ARM), None)
        others = [name for name in own if base is not None and name != base]
        against = {name: judge.against(environment, best[name], best[str(base)]) for name in others}
        relative = {name: cards.changes(found, cards.OVERVIEW) for name, found in against.items()}
        sections[environment] = {"cards": found, "base": base, "against": relative}
    replace_text(folder / PAGE_FILE, cards.rendered("agents.md.j2", sections=sections))


WIDTH = 100
"""Width of the table without a terminal, characters."""


def run(study: Study, part: Study, folder: Path, logs: Path, jobs: int, worlds: int, log: Console) -> None:
    """Train every run of a part of a study that is not finished, and bring all cards up to date.

    Whatever ends it, going on is the same command: finished runs stay, others go on from their checkpoints.

    Args:
        study: what cards tell of.
        part: what is to be trained now.
        folder: for the agents.
        logs: for TensorBoard's files.
        jobs: trainings side by side, of one core each.
        worlds: held-out ones per agent.
        log: where progress is shown.

    Raises:
        CoopenvError: a training cannot be done.
        OutputError: something cannot be written.
    """
    judge, missing = Judge(worlds), unfinished(part, folder)
    total = len(list(part.plans))
    before = total - len(missing)
    folder.mkdir(parents=True, exist_ok=True)

    def judge_finished() -> None:
        finished: dict[Group, list[Plan]] = {}
        for group, seed in product(study.settings, study.seeds):
            if is_finished(plan := study.plan(group, seed), folder):
                finished.setdefault(group, []).append(plan)
        stale = {group: plans for group, plans in finished.items() if not is_reported(group, plans, folder)}
        for group, plans in stale.items():
            write_card(group, plans, folder, judge)
        if stale or not (folder / PAGE_FILE).exists():
            write_overview(list(finished), folder, judge)

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
    for group in study.settings:
        card = cards.read(folder / group.name)
        if "study" not in card:
            continue
        results, errors = card["environments"][group.environment]["results"], cards.seeds_of(card, "e95_m")
        figures = [cards.cell(results[m], factor).replace(" ", "\n", 1) for m, (_, factor) in columns.items()]
        table.add_row(group.name, str(len(errors)), *figures, " ".join(f"{100 * error:.0f}" for error in errors))
    return table
