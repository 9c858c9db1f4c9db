"""Find and load drivers: a folder of `agents/`, any folder, or an import path."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from pydantic import Field, PositiveFloat, ValidationError

from coopenv.base import installation
from coopenv.base.errors import CoopenvError, error_text, explained, printable, shown, suggest
from coopenv.base.installation import data_directory, list_agents
from coopenv.base.sections import Section, one_line, parsed, read_toml
from coopenv.policies.base import PLAIN, Policy, decide, restart, zero_policy

if TYPE_CHECKING:
    from coopenv.scenario import Scenario, ScenarioLike


Kind = Literal["learned", "scripted", "reference"]
Actions = Literal["steering", "choices"]
AGENT_FILE = "agent.toml"
CARD_FILES = ("card.json", "card.md")  # written beside it by `coopenv evaluate --write-card`
CHECKPOINT_FILE = "checkpoint.safetensors"  # in its place while an agent is trained
LATER_FIELDS = {"center", "settings"}
"""Fields of a learned agent's tables that the first versions did not write, without a default."""


class NetworkColumn(Section):
    """A field of the observation or of the action that a network was trained with."""

    start: int
    stop: int
    low: float
    high: float
    scale: float
    center: float
    unit: str


class NetworkCard(Section):
    """The table `network` of an `agent.toml`."""

    weights: str
    """File in the agent's folder."""
    sha256: str
    """SHA-256 of the file."""
    layout: str
    """`layout_hash` of the three tables below."""
    clip: PositiveFloat
    """Normalised observations are clipped to it."""
    observation: dict[str, NetworkColumn]
    action: dict[str, NetworkColumn]
    settings: dict[str, float]
    """Settings of the scenario, by dotted key, that define the meaning of the entries beside these tables."""
    seen: dict[str, tuple[float, float]] = Field(default={})
    """Between which values nearly all entries of a field lay in training, by its name."""
    actions: Actions = "steering"
    """`choices`: outputs are logits of the letters of `Choices`."""
    right_of_way: bool = False
    """Actions keep to the rule `RightOfWay`."""
    alone: str | None = None
    """Agent that drives vehicles that receive nothing, see `Alone`."""


class AgentCard(Section):
    """The contents of an `agent.toml`."""

    title: str
    description: str
    entry: str
    """`package.module:Class`, or `file.py:Class` in the agent's folder; called with the scenario and the options."""
    environments: tuple[str, ...]
    """Environments that it was made for: names, or TOML files in the agent's folder."""
    kind: Kind = "scripted"
    """Trained, scripted, or a reference for the achievable."""
    options: dict[str, Any] = Field(default={})
    """Keyword arguments of the entry."""
    network: NetworkCard | None = None
    """Network of a learned agent: weights, and observation and action of the training."""
    training: dict[str, Any] = Field(default={})
    """Command, seed and versions of the training."""
    results: dict[str, Any] = Field(default={})
    """Results on held-out maps at the end of the training."""


class Agent(AgentCard):
    """A driver that has been found, not yet built: the contents of its card, valid in any folder.

    One of an import path has no more than a name and an entry: a class, which is built with the scenario and the
    options, or else a policy.
    """

    name: str
    """Name of the agent in tables."""
    title: str = ""
    """Title of its card."""
    description: str = ""
    """Description of its card."""
    environments: tuple[str, ...] = ()
    """Environments of its card, with absolute paths."""
    code: Any = None
    """The class or function itself, if it is not named."""
    folder: Path | None = None
    """Folder of its `agent.toml` and its card; None for an import path."""

    def policy(self, scenario: Scenario) -> Policy:
        """Return it as a policy for an environment's vehicles (`env.scenario`).

        Raises:
            CoopenvError: there is no such code, or it cannot drive this environment.
        """
        made: Any = installation.load_reference(self.entry) if self.code is None else self.code
        if not isinstance(made, type):
            if self.options or not callable(made):
                raise CoopenvError(f"agent '{self.name}': {self.entry} is not a class, nor a function without options")
            return cast(Policy, made)
        try:
            policy: Policy = made(scenario, **self.options)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # code of a user
            plain = isinstance(error, ValueError | TypeError | KeyError)
            raise CoopenvError(
                f"agent '{self.name}' cannot be built: {error if plain else error_text(error)}"
            ) from error
        if not callable(policy):
            raise CoopenvError(f"agent '{self.name}': {self.entry} cannot be called with observations")
        return policy


def read_card(folder: Path) -> AgentCard:
    """Read the `agent.toml` of a folder.

    Raises:
        CoopenvError: the file is not valid.
    """
    path = folder / AGENT_FILE
    raw = read_toml(path)
    try:
        return parsed(AgentCard, raw)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        if all(each["type"] == "missing" and each["loc"][-1] in LATER_FIELDS for each in errors):
            renewal = _training_anew(folder, raw.get("training"))
            raise CoopenvError(f"{path}: saved by an earlier version of coopenv; train it anew: {renewal}") from None
        raise CoopenvError(one_line(error, str(path), AgentCard)) from None


def _training_anew(folder: Path, training: Any) -> str:
    """Return the command that puts an agent in the place of one that was trained by an earlier version."""
    known = training if isinstance(training, dict) else {}
    name = str(known.get("environment", "ENV"))
    words = ["coopenv", "train", str(folder / name) if name.endswith(".toml") else name]
    if (folder / "train.toml").is_file():
        words += ["--settings", str(folder / "train.toml")]
    if "seed" in known:
        words += ["--seed", str(known["seed"])]
    return shlex.join([*words, "--out", str(folder), "--force"])


class ModelPolicy:
    """The policy of a model with `predict`; one of Stable-Baselines3 keeps its memory and its `VecNormalize`."""

    def __init__(self, model: Any) -> None:
        self._predict: Any = model.predict
        self._remembers = "episode_start" in inspect.signature(model.predict).parameters
        self._normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
        self._state: Any = None
        self._begins = np.zeros(0, dtype=bool)

    def reset(self, mask: np.ndarray) -> None:
        """Clear the memory of the rows in a mask (rows,)."""
        same = len(mask) == len(self._begins)
        self._begins = self._begins | mask if same else np.ones(len(mask), dtype=bool)
        self._state = self._state if same else None

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return the most likely actions (rows, A) for observations (rows, D)."""
        if len(rows) != len(self._begins):
            self.reset(np.ones(len(rows), dtype=bool))
        if self._normaliser is not None:
            rows = self._normaliser.normalize_obs(rows)
        if not self._remembers:
            return np.asarray(self._predict(rows, deterministic=True)[0])
        actions, self._state = self._predict(rows, self._state, self._begins, deterministic=True)
        self._begins = np.zeros(len(rows), dtype=bool)
        return np.asarray(actions)


def find_agent(name_or_place: str | Path | Callable[..., Any]) -> Agent:
    """Return the driver behind a name of `agents/`, a folder, `file.py:Name` or `package.module:Name`, or such code.

    Code may be a model with a method `predict`, as of Stable-Baselines3. It runs: name only what you trust.

    Raises:
        CoopenvError: there is none, or its `agent.toml` is not valid.
    """
    is_model = not isinstance(name_or_place, type) and hasattr(name_or_place, "predict")
    if callable(name_or_place) or is_model:
        name = getattr(name_or_place, "__name__", type(name_or_place).__name__)
        return Agent(name=name, entry=name, code=ModelPolicy(name_or_place) if is_model else name_or_place)
    name, names = str(name_or_place), list_agents()
    if name not in names and installation.is_reference(name):
        return Agent(name=name.rpartition(":")[2], entry=installation.absolute_reference(name))
    check_agent(name)
    folder = data_directory("agents") / name if name in names else Path(name)
    card = read_card(folder)
    if not installation.is_reference(card.entry):
        raise CoopenvError(f"{folder / AGENT_FILE}: entry: expected file.py:Class or package.module:Class")
    network = {} if card.network is None else {"folder": folder, "network": card.network}
    absolute = {
        "entry": installation.absolute_reference(card.entry, folder),
        "environments": tuple(str(folder / name) if name.endswith(".toml") else name for name in card.environments),
        "options": {**card.options, **network},
    }
    return Agent(**{**dict(card), **absolute}, name=printable(folder.resolve().name), folder=folder)


def check_agent(name: str, what: str = "agent", others: Iterable[str] = ()) -> None:
    """Check that a name is that of a driver, without loading any; `others` are further valid names.

    Raises:
        CoopenvError: there is none, which `what` was to be.
    """
    names = [*others, *list_agents()]
    if installation.is_reference(name):
        installation.check_reference(name)
        return
    if name in names or (Path(name) / AGENT_FILE).is_file():
        return
    if (Path(name) / CHECKPOINT_FILE).is_file():
        raise CoopenvError(f"{name} holds an unfinished training: go on with coopenv train ENV --out {name} --resume")
    if name.endswith(".py"):
        raise CoopenvError(f"{name}: name a class or function in it: {name}:Class")
    if Path(name).is_dir():
        raise CoopenvError(f"{name}: there is no {AGENT_FILE} in this folder")
    known = f"{', '.join(names)}; or a folder with agent.toml, or FILE.py:CLASS"
    raise CoopenvError(f"unknown {what} {shown(name)}{suggest(name, names)}; known: {known}")


def agents_for(environment: str) -> list[str]:
    """Return the names of the shipped drivers that were made for an environment."""
    return [name for name in list_agents() if environment in find_agent(name).environments]


@partial(explained, hint=", for example load_agent('peek', 'facade')")
def load_agent(name_or_place: str | Path | Callable[..., Any], scenario: ScenarioLike) -> Policy:
    """Return a driver for the vehicles of an environment or scenario, by what `find_agent` takes.

    Raises:
        CoopenvError: no such agent, or it cannot drive this environment.
    """
    from coopenv.scenario import load_scenario

    return find_agent(name_or_place).policy(load_scenario(scenario))


def load_policy(name: str | Path | Callable[..., Any], scenario: Scenario, seed: int) -> Policy:
    """Return a policy by what `--policy` takes: `zero`, `random` (with a seed), or what `find_agent` takes.

    Raises:
        CoopenvError: there is no such policy, or the agent cannot drive in this scenario.
    """
    if isinstance(name, str):
        if name in PLAIN:
            return PLAIN[name](seed, scenario.action_size)
        check_agent(name, "policy", PLAIN)
    return load_agent(name, scenario)


def driver_of(others: str | Policy | None, scenario: Scenario) -> Policy:
    """Return the policy of `load_agent`, for None `route_follower`, or straight on where that cannot drive.

    Raises:
        CoopenvError: it is no such driver, or cannot drive in this scenario.
    """
    if not (others is None or isinstance(others, str | Path) or callable(others) or hasattr(others, "predict")):
        expected = "expected one agent for all other vehicles, a name, a folder, file.py:Class or a policy"
        raise CoopenvError(f"others: {expected}, got {shown(others)}")
    try:
        return load_agent("route_follower" if others is None else others, scenario)
    except CoopenvError:
        if others is not None:
            raise
        return zero_policy(width=scenario.action_size)


class ScriptedVehicles:
    """The drivers of a batch of worlds, one policy per agent that the scenario names."""

    def __init__(self, scenario: Scenario) -> None:
        """Load the agents. Raises CoopenvError: there is no such agent, or it cannot drive in this scenario."""
        self.policies: dict[str, Policy] = {}
        self._vehicles: dict[str, list[int]] = {}
        for i, driver in enumerate(scenario.drivers):
            if driver is None:
                continue
            self._vehicles.setdefault(driver, []).append(i)
            try:
                self.policies.setdefault(driver, load_agent(driver, scenario))
            except CoopenvError as error:
                raise CoopenvError(f"vehicles.{i}.motion.driver: {error}") from None

    def restart(self, worlds: np.ndarray, vehicles: int) -> None:
        """Begin new episodes in the worlds of a mask (W,), bool."""
        for policy in self.policies.values():
            restart(policy, np.repeat(worlds, vehicles))

    def act(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Write the actions (W, N, A) of the scripted vehicles for observations (W, N, D).

        A policy gets the rows of all vehicles, since the index of a row is that of the vehicle.
        """
        rows = observations.reshape(-1, observations.shape[-1]).copy()
        for driver, policy in self.policies.items():
            chosen = decide(policy, rows, actions.shape[-1]).reshape(actions.shape)
            actions[:, self._vehicles[driver]] = chosen[:, self._vehicles[driver]]

    def get_state(self) -> dict[str, Policy]:
        """Return copies of the policies, which may have a memory."""
        return deepcopy(self.policies)

    def set_state(self, state: object) -> None:
        """Restore what `get_state` returned. Raises CoopenvError: it is of other drivers; nothing has changed then."""
        if not isinstance(state, dict) or [*state] != [*self.policies]:
            raise CoopenvError("state: no drivers of the scripted vehicles in it")
        self.policies = deepcopy(state)
