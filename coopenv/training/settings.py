"""The settings of a training, read from a TOML file, its plan, and the files of both beside an agent."""

import json
import re
import shutil
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, model_validator

from coopenv.api.terms.layout import observation_layout, settings_of_meaning
from coopenv.base.errors import CoopenvError, OutputError, check_one_of, listed
from coopenv.base.files import writing
from coopenv.base.installation import (
    beside,
    data_directory,
    is_reference,
    is_scene,
    list_agents,
    list_envs,
    scenario_path,
)
from coopenv.base.sections import NonNegative, Positive, Probability, Section, read_toml, toml_of, validated
from coopenv.policies.loader import AGENT_FILE, Actions, load_agent
from coopenv.policies.network import RightOfWay
from coopenv.scenario import Scenario
from coopenv.scenario.cosimulators import FILES
from coopenv.scenario.files import merged
from coopenv.scenario.own_terms import SECTIONS, located
from coopenv.scenario.scenes import scene_text
from coopenv.sources.sources import open_simulation

SETTINGS_FILE = "train.toml"
Count = Annotated[int, Field(gt=0, le=2**31)]
Several = Annotated[int, Field(gt=1, le=2**31)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]


class Ppo(Section):
    """Proximal policy optimisation (Schulman et al. 2017) with parameters shared over vehicles."""

    vehicles: Count = 512
    """Driven vehicles in parallel, in as many worlds as hold them: every environment has the same batch size."""
    decisions: Count = 64
    """Decision steps of a rollout, between two updates of the policy."""
    minibatches: Count = 16
    """Gradient steps per pass over a rollout."""
    epochs: Count = 4
    """Passes over each rollout."""
    learning_rate: Positive = 1e-3
    """Initial learning rate of Adam; falls linearly to zero."""
    gamma: Share | None = None
    """Discount per decision; without: 1 - 1 / the decisions of an episode, so that its end counts from the start."""
    gae_lambda: Probability = 0.95
    """Lambda of the generalised advantage estimate (Schulman et al. 2016)."""
    clip: Positive = 0.2
    """Clipping range of the probability ratio."""
    critic_first: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.8
    """Share of the returns' variance that the critic explains before the policy of a clone, or of an agent that the
    training continues, moves; after a quarter of the steps it moves in any case. 0: at once."""
    entropy: NonNegative = 0.0
    """Weight of the entropy bonus."""
    value_weight: NonNegative = 0.5
    """Weight of the value loss."""
    max_gradient: Positive = 0.5
    """Norm at which gradients are clipped."""
    reward_scale: Positive | Literal["spread"] = 0.1
    """Factor of rewards, for values of order one; `spread`: 1 / the running standard deviation of discounted returns,
    for rewards of another size, such as those of a team."""
    initial_std: Positive = 0.5
    """Initial standard deviation of the exploration; actions reach from -1 to 1."""
    hidden: tuple[Count, ...] = Field(default=(128, 128), min_length=1)
    """Widths of the hidden layers (tanh) of policy and value."""
    memory: Annotated[int, Field(gt=0, le=4096)] | None = None
    """Width of a memory, a gated recurrent unit, that policy and value read beside the observation; it is learnt along
    whole rollouts. A clone begins with an empty one, as does a `start` that has none."""
    observation_clip: Positive = 6.0
    """Bound of observations after normalisation by running mean and standard deviation."""

    @model_validator(mode="after")
    def _check_rollout(self) -> "Ppo":
        if self.vehicles * self.decisions < 2:
            raise ValueError("decisions: one decision of one vehicle is no rollout, advantages need two at least")
        return self

    def discount(self, scenario: Scenario) -> float:
        """Return the discount per decision in a scenario."""
        return self.gamma or 1.0 - 1.0 / max(2, scenario.decisions)


class Clone(Section):
    """A start from the behaviour of another driver, whose actions and returns are learnt by regression first."""

    agent: Annotated[tuple[str, ...], Field(min_length=1)] | str
    """Agent whose actions and returns are learnt by regression before training: name, folder or `file.py:Class`. Of
    several the best one by the score, in the worlds for evaluation during training."""
    episodes: Count = 64
    """Recorded worlds, one episode each."""
    rounds: Count = 1
    """Rounds, each with its part of the worlds: after the first the clone drives, and the agent's actions are what it
    should have done (Ross et al. 2011)."""
    epochs: Count = 20
    """Passes over the recorded actions, in every round."""
    learning_rate: Positive = 1e-3
    """Learning rate of Adam."""
    noise: NonNegative = 0.1
    """Standard deviation of noise added to the agent's actions, so that corrections are recorded, too; share of letters
    that are drawn."""
    smoothing: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.1
    """Share of the probability that is spread over all letters (label smoothing), so that the clone explores."""
    elsewhere: tuple[str, ...] | None = None
    """Environments of the demonstrations for a network over sets, in place of the trained one, which is left out."""

    @property
    def agents(self) -> tuple[str, ...]:
        """All agents."""
        return (self.agent,) if isinstance(self.agent, str) else self.agent


class Variation(Section):
    """Worlds to learn in that differ from the others."""

    share: Annotated[float, Field(gt=0.0, le=1.0)]
    """Share of the worlds; at least one world."""
    scenario: dict[str, Any]
    """Overrides that go before all others."""


class EvaluationSettings(Section):
    """Judging the mean action on held-out maps."""

    every: Count = 250_000
    """Decisions of vehicles between two evaluations."""
    worlds: Several = 32
    """Held-out worlds of an evaluation during training, one episode each."""
    final_worlds: Several = 256
    """Held-out worlds of the last evaluation, for the results in `agent.toml`."""
    keep: Literal["best", "last"] = "best"
    """Policy of the agent: the best in the worlds of these evaluations, which the true errors rank, or the last."""
    drivers: tuple[str, ...] = ("peek", "look_ahead")
    """Drivers that the result is ranked among, beside the cloned driver and the clone; those that can drive here."""


class Settings(Section):
    """Everything that decides how a training goes, but for environment and seed."""

    steps: Annotated[int, Field(ge=0, le=2**31)] = 2_000_000
    """Length of the training, decisions of vehicles; 0: the clone alone."""
    minutes: Positive | None = None
    """Longest time of learning, min; a training that it stops depends on the machine and its load."""
    start: str | None = None
    """Learned agent that the training continues, name or folder (from here or the file's), with critic and scaling."""
    actions: Actions = "steering"
    """`steering`: an action of the environment every decision; `choices`: letters of `Choices`, kept for half a second,
    which stand for decisions in all counts but that of `ppo.gamma`."""
    right_of_way: bool = False
    """Limit the speeds to those at which the driver `look_ahead` gives way, and follow its plans where a vehicle stands
    in the way or the route is too far away."""
    alone: str | None = None
    """Agent of coopenv's that drives in place of the policy where a vehicle receives no message in its first second."""
    scenario: dict[str, Any] = Field(default={})
    """Overrides of the scenario, as tables or dotted keys, as with `--override`."""
    randomised: dict[str, Any] = Field(default={})
    """Further ones for the worlds to learn in alone, such as `randomisation.camera_range = [0.7, 2.0]`."""
    variations: tuple[Variation, ...] = ()
    """Further ones for some of these worlds."""
    ppo: Ppo = Ppo()
    evaluation: EvaluationSettings = EvaluationSettings()
    clone: Clone | None = None
    network: Literal["sets"] | None = None
    """`sets`: a driver for any environment steers by sets of landmarks and cars; a clone alone, `steps = 0`."""

    @model_validator(mode="after")
    def _check_network(self) -> "Settings":
        if self.network and (self.steps != 0 or self.clone is None):
            raise ValueError(f"network: '{self.network}' learns by a clone alone: set clone.agent and steps = 0")
        if self.steps == 0 and self.clone is None:
            raise ValueError("steps: 0 is for a clone alone, nothing is learnt without [clone]")
        if self.start is not None and self.clone is not None:
            raise ValueError("start: a training begins as an agent or as a [clone], give one of them")
        if self.steps == 0 and self.ppo.memory:
            raise ValueError("ppo.memory: a clone alone has none, set steps")
        if self.actions == "choices" and (self.right_of_way or self.network):
            raise ValueError("actions: choices keep the right of way already, and need no right_of_way and no network")
        if self.network and self.alone is not None:
            raise ValueError(f"alone: not with network = '{self.network}'")
        if sum(variation.share for variation in self.variations) > 1.0:
            raise ValueError("variations: their shares add up to more than 1")
        if not self.network and self.clone is not None and self.clone.elsewhere is not None:
            raise ValueError("clone.elsewhere: only with network = 'sets', since observations differ")
        return self


@dataclass(frozen=True)
class TrainingPlan:
    """Plan of a training; two runs of one plan and one version on one machine give the same policy."""

    environment: str
    settings: Settings
    seed: int
    arm: str | None = None
    overrides: Mapping[str, Any] | None = None
    """Overrides of the command line, applied after the overrides of the settings."""

    @property
    def all_overrides(self) -> dict[str, Any]:
        """Every override of the scenario by its dotted key."""
        return {**self.settings.scenario, **(self.overrides or {})}

    @property
    def portable(self) -> Settings:
        """The settings with all overrides as they are beside the agent, with references to copies there."""
        return self.settings.model_copy(update={"scenario": _with_code_beside(self.all_overrides, {})})

    def watched(self) -> "list[TrainingPlan]":
        """Return the plan in each environment whose worlds are learnt in."""
        elsewhere = self.settings.clone.elsewhere if self.settings.clone else None
        return [replace(self, environment=name) for name in elsewhere or () if name != self.environment] or [self]

    def scenarios(self, worlds: int = 1) -> list[tuple[Scenario, int]]:
        """Return of which scenarios so many worlds to learn in are, and how many of each.

        Raises:
            CoopenvError: an override is not possible there, or changes what is observed or what actions mean.
        """
        settings, found = self.settings, list[tuple[Scenario, int]]()
        judged = _meaning(open_simulation(self.environment, self.all_overrides))
        randomised = {**self.all_overrides, **settings.randomised}
        plain = open_simulation(self.environment, randomised)
        varied = [open_simulation(self.environment, {**randomised, **own.scenario}) for own in settings.variations]
        changes = [("randomised", settings.randomised), *(("variations", own.scenario) for own in settings.variations)]
        for (name, change), scenario in zip(changes, [plain, *varied], strict=True):
            here = _meaning(scenario)
            if differing := [key for key in {**judged, **here} if here.get(key) != judged.get(key)]:
                raise CoopenvError(f"{name}: {change} changes the meaning of entries: {listed(differing, 4)}")
        found = [(s, max(1, round(own.share * worlds))) for s, own in zip(varied, settings.variations, strict=True)]
        left = worlds - sum(count for _, count in found)
        if left > 0 or not found:
            found.insert(0, (plain, max(1, left)))
        return found


def _meaning(scenario: Scenario) -> dict[str, object]:
    """Return by name the settings that define the entries of observations and actions."""
    layout = observation_layout(scenario)
    return {
        **layout,
        "actions": layout.actions,
        **settings_of_meaning(scenario, layout),
        "driven vehicles": any(scenario.acting),
    }


def read_settings(
    path: Path | None, arm: str | None = None, environment: str | None = None, **changes: Any
) -> Settings:
    """Read settings, None for all defaults.

    Args:
        path: a TOML file with the keys of `Settings`; under `environments` and `arms` tables of the same keys by name.
        arm: the table under `arms` whose values go before the others.
        environment: name of the one that is trained in; the table under `environments`, if there is one, goes before
            what is for all, and the table of the arm under its own `arms` before everything.
        **changes: values that go before those of the file, where they are not None.

    Raises:
        CoopenvError: no such file or arm, or it is not valid; one line that names file and field.
    """
    where, raw = (str(path), read_toml(path)) if path is not None else ("settings", {})
    raw = _flattened(raw, where)
    if path is not None and ((begun := path.parent / str(raw.get("start"))) / AGENT_FILE).is_file():
        raw["start"] = str(begun)
    environments = _tables(raw.pop("environments", {}), f"{where}: environments")
    arms = _tables(raw.pop("arms", {}), f"{where}: arms")
    here = dict(environments.get(environment or "", {}))
    table = f"environments.{environment}"
    arms_here = _tables(here.pop("arms", {}), f"{where}: {table}.arms")
    for name in (*arms_here, *([arm] if arm is not None else [])):
        check_one_of(f"{where}: no arm", name, arms)
    changed = {table: here}
    if arm is not None:
        changed |= {f"arms.{arm}": arms[arm], f"{table}.arms.{arm}": arms_here.get(arm, {})}
    for place, change in changed.items():
        raw = merged(raw, _flattened(change, f"{where}: {place}"))
    raw.update({name: value for name, value in changes.items() if value is not None})
    if changes.get("start") is not None:
        raw.pop("clone", None)
    return validated(Settings, json.dumps(raw, default=str), where)


def continued_settings(path: Path, environment: str, **changes: Any) -> Settings:
    """Return the settings of a training that continues the agent of a file: its own ones.

    Of a clone alone neither reward nor PPO were ever in use: it goes on as the arm `team` does.

    Raises:
        CoopenvError: it is a network over sets; or see `read_settings`.
    """
    begun = read_toml(path)
    if begun.get("network"):
        raise CoopenvError(f"start: {changes['start']} is no policy that PPO learns, but a clone alone")
    if begun.get("steps") != 0:
        return read_settings(path, None, environment, **changes)
    team = read_settings(data_directory("agents") / SETTINGS_FILE, "team", environment, **changes)
    own = read_settings(path, None, environment, **{**changes, "steps": team.steps})
    ppo = team.ppo.model_copy(update={"hidden": own.ppo.hidden, "observation_clip": own.ppo.observation_clip})
    overrides = {key: value for key, value in own.scenario.items() if not key.startswith("reward.")}
    changed = {"ppo": ppo, "scenario": {**team.scenario, **overrides}, "evaluation": team.evaluation}
    return own.model_copy(update=changed)


def usual_settings(environment: str, overrides: Mapping[str, Any], **changes: Any) -> Settings:
    """Return the settings of a training of which nothing else is said.

    They are those of the agents that ship with coopenv, where the driver that these begin as can drive; in other
    environments without their reward, and without variations that are not possible. Several vehicles keep the right of
    way by the rule, where it sees what it needs.
    """
    name, changed = Path(environment).stem, {key: value for key, value in changes.items() if value is not None}
    shipped = read_settings(data_directory("agents") / SETTINGS_FILE, USUAL_ARM, name)
    settings = shipped.model_copy(update={**changed, **({"clone": None} if "start" in changed else {})})
    if f"{environment}_{USUAL_ARM}" not in list_agents():
        settings = settings.model_copy(update={"scenario": {}})
    try:
        scenario = open_simulation(environment, overrides)
        for name in settings.clone.agents if settings.clone else ():
            load_agent(name, scenario)
    except CoopenvError:
        return read_settings(None, None, name, **changes)
    often = min(settings.evaluation.every, max(1, settings.steps // LOOKS))
    evaluation = settings.evaluation.model_copy(update={"every": often})
    settings = settings.model_copy(update={"evaluation": evaluation})
    if len(scenario.vehicles) > 1:
        with suppress(ValueError):  # the observation lacks what the rule needs
            RightOfWay(scenario)
            settings = settings.model_copy(update={"right_of_way": True})
    fitting = []
    for own in settings.variations:
        with suppress(CoopenvError):
            alone = settings.model_copy(update={"variations": (own,)})
            TrainingPlan(environment, alone, 0, overrides=overrides).scenarios()
            fitting.append(own)
    return settings.model_copy(update={"variations": tuple(fitting)})


USUAL_ARM = "quality"
LOOKS = 8
"""Evaluations, at least, of a training with `usual_settings`."""


def _tables(tables: Any, where: str) -> dict[str, dict[str, Any]]:
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise CoopenvError(f"{where}: expected tables by name")
    return tables


def _flattened(raw: dict[str, Any], where: str) -> dict[str, Any]:
    """Return settings with overrides of scenarios by dotted keys."""
    flat: dict[str, Any] = {
        name: _flat(raw[name], f"{where}: {name}") for name in ("scenario", "randomised") if name in raw
    }
    variations = raw.get("variations")
    if isinstance(variations, list):
        flat["variations"] = [
            _flattened(own, f"{where}: variations.{i}") if isinstance(own, dict) else own
            for i, own in enumerate(variations)
        ]
    return {**raw, **flat}


def _flat(tables: Any, where: str) -> dict[str, Any]:
    """Return tables within tables as one of dotted keys."""
    if not isinstance(tables, dict):
        raise CoopenvError(f"{where}: expected a table")
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        inner = _flat(value, where) if isinstance(value, dict) else None
        flat.update({key: value} if inner is None else {f"{key}.{name}": each for name, each in inner.items()})
    return flat


class EnvironmentFile(NamedTuple):
    """The environment as an agent's folder holds it."""

    title: str
    """Name of the environment in texts."""
    name: str
    """Name in `agent.toml`: an environment of coopenv, or a file beside `agent.toml`."""
    text: str | None = None
    """Contents of that file."""
    code: Mapping[str, Path] = {}
    """Files of own terms, by the names of their copies beside it."""


def environment_file(environment: str, overrides: Mapping[str, Any] | None = None) -> EnvironmentFile:
    """Return an environment, by its name or TOML file, as it goes with an agent that learnt with these overrides.

    Raises:
        CoopenvError: there is none, or two different files of own terms have one name.
    """
    code: dict[str, Path] = {}
    _with_code_beside(overrides or {}, code)
    if environment in list_envs():
        return EnvironmentFile(environment, environment, None, code)
    if is_scene(environment):
        name = re.sub(r"[^A-Za-z0-9]+", "_", environment)
        return EnvironmentFile(environment, f"{name}.toml", scene_text(environment), code)
    path = scenario_path(environment)
    name = f"{path.stem}.toml"
    if name in (AGENT_FILE, SETTINGS_FILE):  # which stand there
        name = "environment.toml"
    return EnvironmentFile(path.stem, name, _movable(path.read_text(encoding="utf-8-sig"), path.parent, code), code)


def _with_code_beside(overrides: Mapping[str, Any], code: dict[str, Path]) -> dict[str, Any]:
    """Return overrides, in which own terms name copies of their files, which are noted in `code`."""
    own = {key: value for key, value in overrides.items() if ".custom." in key and isinstance(value, str)}
    return {**overrides, **{key: beside(value, Path.cwd(), code) for key, value in own.items() if is_reference(value)}}


def _movable(text: str, folder: Path, code: dict[str, Path]) -> str:
    """Return a scenario of some folder as it means the same with copies of its files and own terms beside it."""
    raw = tomllib.loads(text)
    changed = located(raw, folder, partial(beside, code=code))
    if changed == raw:
        return text
    import tomlkit  # of the extra `train`

    document = tomlkit.parse(text)
    for section in SECTIONS:
        rows = changed.get(section, {}).get("custom", {})
        for name, row in rows.items():
            document[section]["custom"][name] = row
    for section, keys in FILES.items():
        for key in {*keys} & changed.get(section, {}).keys():
            document[section][key] = changed[section][key]
    return tomlkit.dumps(document)


def settings_text(plan: TrainingPlan) -> str:
    """Return the settings of a training, defaults and overrides among them, as TOML."""
    import tomlkit  # of the extra `train`

    return tomlkit.dumps(plan.portable.model_dump(mode="json", exclude_none=True))


def settings_digest(plan: TrainingPlan) -> str:
    """Return the SHA-256 of `settings_text`, by which a later training knows the file for the agent's."""
    return sha256(settings_text(plan).encode()).hexdigest()


def check_settings(folder: Path, plan: TrainingPlan, environment: EnvironmentFile) -> None:
    """Find out before any work whether `write_settings` can be done.

    Raises:
        OutputError: a folder holds other settings, and they are not those of an agent in it but the user's own.
    """
    path = folder / SETTINGS_FILE
    if path.exists() and not _says(path, plan, environment) and not _is_the_agents(path):
        raise OutputError(
            f"{path}: no agent's, and this training has other settings: name another folder with --out, or move it"
        )


def write_settings(folder: Path, old: Path, plan: TrainingPlan, environment: EnvironmentFile) -> None:
    """Write the settings of a training to the new folder of its agent; a file that says the same goes along as it is.

    Args:
        folder: to write to.
        old: whose place it takes.
        plan: of the training.
        environment: of the training.

    Raises:
        OutputError: it cannot be written, or see `check_settings`.
    """
    check_settings(old, plan, environment)
    new = folder / SETTINGS_FILE
    with writing(new):
        if (old / SETTINGS_FILE).exists() and _says(old / SETTINGS_FILE, plan, environment):
            shutil.copy2(old / SETTINGS_FILE, new, follow_symlinks=False)
        else:
            new.write_text(settings_text(plan), encoding="utf-8", newline="\n")


def _says(path: Path, plan: TrainingPlan, environment: EnvironmentFile) -> bool:
    """Return whether `coopenv train` with a file and no other option has the settings of a plan."""
    try:
        settings = read_settings(path, None, Path(environment.name).stem)
    except CoopenvError:
        return False
    return settings == plan.portable


def _is_the_agents(path: Path) -> bool:
    """Return whether `coopenv train` has written a file that was not changed since."""
    try:
        card: dict[str, Any] = toml_of((path.parent / AGENT_FILE).read_text(encoding="utf-8"))
        known = card["training"].get("settings")  # earlier versions noted none
        return known is None or known == sha256(path.read_bytes()).hexdigest()
    except (OSError, ValueError, RecursionError, KeyError, AttributeError):
        return False
