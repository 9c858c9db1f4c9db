"""The trainings of a study: settings, which are done, and how their agents drive."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from coopenv.api.engine import Engine
from coopenv.backends.sources import open_simulation
from coopenv.base.errors import CoopenvError, suggest
from coopenv.base.sections import Section, read_toml, validated
from coopenv.bench.contest import IDEAL_SENSING
from coopenv.evaluation import Difference, Episodes, Result, compare_paired, drive, held_out_seeds, score
from coopenv.policies import load_agent
from coopenv.policies.loader import AGENT_FILE, CHECKPOINT_FILE, read_card
from coopenv.training.settings import SETTINGS_FILE, Plan, Settings, read_settings

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


class Run(NamedTuple):
    """One training."""

    group: Group
    seed: int

    @property
    def folder(self) -> Path:
        """Where its agent goes, in the study's folder."""
        return Path(self.group.name, f"seed_{self.seed}")


@dataclass(frozen=True)
class Study:
    """What is to be trained."""

    settings: dict[Group, Settings]
    """Of every agent, by environment and then by arm."""
    seeds: tuple[int, ...]

    @property
    def groups(self) -> list[Group]:
        """All agents, by environment."""
        return list(self.settings)

    @property
    def runs(self) -> Iterator[Run]:
        """All trainings; every agent's first one before any agent's second."""
        return (Run(group, seed) for seed in self.seeds for group in self.groups)

    def plan(self, run: Run) -> Plan:
        """Return what exactly a run trains."""
        return Plan(run.group.environment, self.settings[run.group], run.seed, run.group.arm)

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


@dataclass(frozen=True)
class Task:
    """One training as it is sent to another process."""

    plan: Plan
    out: Path
    logs: Path


def tasks(study: Study, folder: Path, logs: Path) -> list[Task]:
    """Return the trainings of a study that are not finished.

    Raises:
        CoopenvError: one of them is not possible: better now than when the others have been waited for.
    """
    from coopenv.training.command import possible  # needs the extra `train`

    runs = [run for run in study.runs if not is_finished(study, run, folder)]
    for run in runs:
        try:
            possible(study.plan(run))
        except CoopenvError as error:
            raise CoopenvError(f"{run.folder}: {error}") from None
    return [Task(study.plan(run), folder / run.folder, logs / run.folder) for run in runs]


def is_finished(study: Study, run: Run, folder: Path) -> bool:
    """Return whether a run's agent is there, trained as in the present study and environment."""
    from coopenv.training.export import scenario_digest  # needs the extra `train`

    place, plan = folder / run.folder, study.plan(run)
    if not (place / AGENT_FILE).is_file() or not (place / SETTINGS_FILE).is_file():
        return False
    try:
        card, settings = read_card(place), read_settings(place / SETTINGS_FILE)
    except (CoopenvError, tomllib.TOMLDecodeError):
        return False
    known = [card.training.get(key) for key in ("environment", "seed", "arm", "scenario")]
    scenario = scenario_digest(open_simulation(plan.environment, plan.all_overrides))
    return known == [plan.environment, plan.seed, plan.arm, scenario] and settings == plan.settings


def perform(task: Task) -> None:
    """Train on one core, going on from a checkpoint where there is one of the same training.

    An agent that is there has been trained with other settings, and is replaced.

    Raises:
        CoopenvError: what `train` raises.
    """
    from coopenv.training.command import read, train  # needs the extra `train`

    path = task.out / CHECKPOINT_FILE
    resume = path.is_file() and read(path).plan == task.plan
    if not resume:
        path.unlink(missing_ok=True)  # of a training with other settings
    task.logs.mkdir(parents=True, exist_ok=True)
    train(task.plan, task.out, resume=resume, threads=1, logs=task.logs, force=True)


REPORTED, CHOSEN = 0, 1
"""Blocks of held-out seeds: figures on cards are of the first; which seed is the best is decided in the second."""

Key = tuple[str, ...]
"""Environment, agent, overrides, and when its weights were written."""


class Judge:
    """Drives agents in the same worlds, and remembers what came of it: figures, and one environment's episodes."""

    def __init__(self, worlds: int) -> None:
        """Take so many worlds of either block."""
        self.worlds = worlds
        self._environment = ""
        self._episodes: dict[Key, Episodes] = {}
        self._results: dict[Key, list[Result]] = {}
        self._differences: dict[tuple[Key, Key], list[Difference]] = {}
        self._merits: dict[Key, float] = {}

    def results(self, environment: str, agent: str | Path, overrides: Mapping[str, Any] | None = None) -> list[Result]:
        """Return the figures of an agent in the reported worlds, under overrides of the environment."""
        key = _key(environment, agent, overrides or {})
        if key not in self._results:
            self._results[key] = score(self._reported(environment, agent, overrides or {}))
        return self._results[key]

    def ideal(self, environment: str, agent: str) -> list[Result]:
        """Return those of an agent that sees everything."""
        return self.results(environment, agent, IDEAL_SENSING)

    def against(self, environment: str, agent: str | Path, other: str | Path) -> list[Difference]:
        """Return how much an agent's figures differ from another's in the same worlds."""
        pair = _key(environment, agent, {}), _key(environment, other, {})
        if pair not in self._differences:
            own, others = (self._reported(environment, each, {}) for each in (agent, other))
            self._differences[pair] = compare_paired(own, others)
        return self._differences[pair]

    def merit(self, environment: str, agent: Path, overrides: Mapping[str, Any]) -> float:
        """Return the mean return of an agent by the reward that it learnt from, in worlds of the other block."""
        key = _key(environment, agent, overrides)
        if key not in self._merits:
            results = score(self._drive(environment, agent, overrides, CHOSEN))
            self._merits[key] = {result.metric: result.mean for result in results}["return"]
        return self._merits[key]

    def _reported(self, environment: str, agent: str | Path, overrides: Mapping[str, Any]) -> Episodes:
        if environment != self._environment:  # episodes are large, and those of one environment are wanted together
            self._environment = environment
            self._episodes.clear()
        key = _key(environment, agent, overrides)
        if key not in self._episodes:
            self._episodes[key] = self._drive(environment, agent, overrides, REPORTED)
        return self._episodes[key]

    def _drive(self, environment: str, agent: str | Path, overrides: Mapping[str, Any], block: int) -> Episodes:
        scenario = open_simulation(environment, overrides)
        engine = Engine(scenario, self.worlds)
        try:
            return drive(engine, load_agent(agent, scenario), held_out_seeds(block, self.worlds))
        finally:
            engine.close()


def _key(environment: str, agent: str | Path, overrides: Mapping[str, Any]) -> Key:
    """Return what episodes depend on: weights that are trained anew are another agent."""
    weights = sorted(str(path.stat().st_mtime_ns) for path in Path(agent).glob("*.safetensors"))
    return (environment, str(agent), repr(sorted(overrides.items())), *weights)
