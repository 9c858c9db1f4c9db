"""Which agents a study trains: environments, arms of the settings, and seeds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field

from coopenv.base.errors import CoopenvError, suggest
from coopenv.base.sections import Section, read_toml, validated
from coopenv.training.settings import Plan, Settings, read_settings

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
                told = f"{suggest(word, known)}; known: {', '.join(sorted(known))}"
                raise CoopenvError(f"--only: the study has no '{word}'{told}")
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
