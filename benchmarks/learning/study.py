"""Trainings of a study by environment, arm and seed: which there are, which are finished, and how one is done."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import compress, groupby, product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from coopenv.base.errors import CoopenvError, check_one_of, listed
from coopenv.base.sections import Section, read_toml, validated
from coopenv.policies.loader import AGENT_FILE, CHECKPOINT_FILE, read_card
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
