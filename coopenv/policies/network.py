"""A learned policy: normalisation and a multilayer perceptron, in NumPy, from weights without pickle."""

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load

from coopenv.api.terms.layout import Layout, observation_layout, settings_of_meaning
from coopenv.base.errors import AgentWarning, CoopenvError
from coopenv.policies.alone import Alone
from coopenv.policies.choices import Choices
from coopenv.policies.loader import NetworkCard, NetworkColumn
from coopenv.policies.look_ahead import LookAhead
from coopenv.policies.memory import MEMORY, PARTS, Memory
from coopenv.scenario import Scenario

ENTRY = f"{__name__}:Network"
"""The `entry` of learned agents."""
FOREIGN = 0.1
"""Share of a field's entries beyond what was seen in training from which on the agent warns."""
SLACK = 0.01
"""By which entries may lie beyond."""
FIRST_LOOK = 100
"""Rows, at least, before it does."""
CRITIC = "critic."
"""Beginning of the names of tensors that only a further training needs."""


def layout_tables(layout: Layout) -> tuple[dict[str, NetworkColumn], dict[str, NetworkColumn]]:
    """Return what a network depends on: fields of the observation, and those of the action, by name in their order."""
    observation = {
        name: NetworkColumn(
            start=f.start, stop=f.stop, low=f.low, high=1.0, scale=f.scale, center=f.center, unit=f.unit
        )
        for name, f in layout.items()
    }
    action = {
        f.name: NetworkColumn(start=i, stop=i + 1, low=f.low, high=f.high, scale=1.0, center=0.0, unit=f.unit)
        for i, f in enumerate(layout.action)
    }
    return observation, action


def layout_hash(
    observation: Mapping[str, NetworkColumn], action: Mapping[str, NetworkColumn], settings: Mapping[str, float]
) -> str:
    """Return the first 16 hexadecimal digits of SHA-256 over the three tables as JSON."""
    tables = [{name: entry.model_dump() for name, entry in table.items()} for table in (observation, action)]
    return sha256(json.dumps([*tables, dict(settings)]).encode()).hexdigest()[:16]


class RightOfWay:
    """A rule below a policy, see `LookAhead.rule`: no speed is larger than its speed, and its plans go first."""

    def __init__(self, scenario: Scenario) -> None:
        """Build it. Raises ValueError: the observation lacks what the rule needs."""
        self._driver = LookAhead(scenario)
        self.agents, self.reset = self._driver.agents, self._driver.reset

    def __call__(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return actions (rows, A) by the rule; rows are those of all vehicles."""
        (plans, *wanted), found = self._driver.rule(observations), np.array(actions)
        speed, turn = self._driver.levels(*wanted).T[:2]
        found[:, 0] = np.where(plans, speed, np.minimum(found[:, 0], speed))
        found[:, 1] = np.where(plans, turn, found[:, 1])
        return found


class NetworkPolicy:
    """A policy by the outputs of a network: actions, or logits of letters that a driver follows, under rules."""

    def __init__(
        self, choices: Choices | None, rules: Sequence[RightOfWay | Alone], tensors: Mapping[str, np.ndarray]
    ) -> None:
        """Begin with an empty memory, if the tensors of the agent's weights have one."""
        self.choices, self._rules = choices, rules
        self._memory = Memory(tensors) if f"{MEMORY}{PARTS[0]}" in tensors else None
        if choices:
            choices.chooser = self.chosen
        self._parts: list[Any] = [part for part in (*rules, self._memory, choices) if part]
        self.agents: list[str] = next((part.agents for part in self._parts if getattr(part, "agents", ())), [])
        """Names of the vehicles in the order of rows, where a rule or a driver needs the rows of all."""

    def chosen(self, observations: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the most likely actions, (rows, A), or letters, (rows,); flags of `rows`, (rows,): see `Memory`."""
        raise NotImplementedError

    def reset(self, mask: np.ndarray) -> None:
        """Begin new episodes in the rows of a mask (rows,), bool."""
        for part in self._parts:
            part.reset(mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions without exploration, (rows, A) in [-1, 1], for flat observations, (rows, D)."""
        actions = self.choices(observations) if self.choices else self.chosen(observations)
        for rule in self._rules:
            actions = rule(np.asarray(observations, dtype=np.float32), actions)
        return actions


class Network(NetworkPolicy):
    """The mean action of a network that `coopenv train` exported; agrees with torch's to rounding.

    It finds its fields by their names and reads larger scales as its own: environments may show more than in training.
    """

    def __init__(self, scenario: Scenario, *, folder: Path, network: NetworkCard) -> None:
        """Load the weights.

        Args:
            scenario: of the environment that it is to drive in.
            folder: of the agent.
            network: what its `agent.toml` says.

        Raises:
            CoopenvError: the environment's observation or action is not what it was trained with, or a setting is not
                that says what they mean, or the weights cannot be read or are not those that the agent was saved with.
        """
        observation, action = layout_tables(observation_layout(scenario))
        _compare("observation", network.observation, observation)
        _compare("action", network.action, action)
        if list(network.action) != list(action):
            before, now = ", ".join(network.action), ", ".join(action)
            raise CoopenvError(f"it was trained with other actions: {before} and not {now}")
        settings = settings_of_meaning(scenario, network.observation)
        for key in sorted({*network.settings, *settings}):
            trained, here = network.settings.get(key), settings.get(key)
            if trained is None or here is None or not math.isclose(trained, here, rel_tol=1e-9):
                raise CoopenvError(f"it was trained with another {key}, {trained!r}, and it is {here!r} here")
        fields = [observation[name] for name in network.observation]
        self._columns = np.concatenate([np.arange(field.start, field.stop) for field in fields])
        self._factor = np.ones(max(field.stop for field in observation.values()), dtype=np.float32)
        for own, field in zip(network.observation.values(), fields, strict=True):
            self._factor[field.start : field.stop] = field.scale / own.scale
        path = folder / network.weights
        if network.layout != layout_hash(network.observation, network.action, network.settings):
            raise CoopenvError(f"{folder / 'agent.toml'}: network.layout is not the hash of its tables")
        self._clip = np.float32(network.clip)
        tensors = load_weights(path, network.sha256)
        tensors = {name: values for name, values in tensors.items() if not name.startswith(CRITIC)}
        rules: list[RightOfWay | Alone] = [RightOfWay(scenario)] if network.right_of_way else []
        rules += [Alone(scenario, network.alone)] if network.alone is not None else []
        choices = Choices(scenario) if network.actions == "choices" else None
        outputs = len(choices.alphabet) if choices else len(action)
        depth = _depth_of(path, tensors, len(self._columns), outputs, spread=not choices)
        super().__init__(choices, rules, tensors)
        self._mean, self._std = tensors["observation.mean"], tensors["observation.std"]
        self._layers = [(tensors[f"layers.{i}.weight"].T.copy(), tensors[f"layers.{i}.bias"]) for i in range(depth)]
        self._name, self._seen, self._rows = folder.resolve().name, dict(network.seen), 0
        self._places = {name: slice(observation[name].start, observation[name].stop) for name in self._seen}
        self._outside = dict.fromkeys(self._seen, 0.0)

    def chosen(self, observations: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """See `NetworkPolicy.chosen`."""
        seen = np.clip(observations * self._factor, -1.0, 1.0)
        if self._seen:
            self._compare_with_training(seen[seen.any(axis=1)])
        scaled = (seen[:, self._columns] - self._mean) / self._std
        values = np.clip(scaled, -self._clip, self._clip).astype(np.float32)
        values = self._memory(values, rows) if self._memory else values
        for weight, bias in self._layers[:-1]:
            values = np.tanh(values @ weight + bias)
        weight, bias = self._layers[-1]
        values = values @ weight + bias
        return np.asarray(np.argmax(values, axis=1) if self.choices else np.clip(values, -1.0, 1.0))

    def _compare_with_training(self, observations: np.ndarray) -> None:
        """Warn, once, where many entries of a field lie beyond those of the training."""
        self._rows += len(observations)
        for name, (low, high) in self._seen.items():
            entries = observations[:, self._places[name]]
            self._outside[name] += ((entries < low - SLACK) | (entries > high + SLACK)).mean(axis=1).sum()
        if self._rows < FIRST_LOOK:
            return
        found = {name: share / self._rows for name, share in self._outside.items() if share > FOREIGN * self._rows}
        if found:
            worst = max(found, key=lambda name: found[name])
            text = f"{found[worst]:.0%} of the entries of '{worst}' are beyond those of its training"
            warnings.warn(AgentWarning(f"agent {self._name}: {text}"), stacklevel=2)
            self._seen = {}


def _compare(what: str, trained: Mapping[str, NetworkColumn], here: Mapping[str, NetworkColumn]) -> None:
    """Name the first field that differs; it may stand elsewhere and have a larger scale, and there may be more here."""
    for name, entry in trained.items():
        before = f"it was trained with another {what}: '{name}'"
        if name not in here:
            raise CoopenvError(f"{before} is not in this environment")
        both = [{"size": c.stop - c.start, **c.model_dump(exclude={"start", "stop"})} for c in (entry, here[name])]
        for key, value in both[0].items():
            now = both[1][key]
            same = value == now if isinstance(value, str) else np.isclose(value, now, rtol=1e-9)
            if not same and (key != "scale" or now < value):
                raise CoopenvError(f"{before} had {key} {value!r} and has {now!r} here")


def load_weights(path: Path, digest: str) -> dict[str, np.ndarray]:
    """Return the tensors of a file of weights, float32.

    Raises:
        CoopenvError: it cannot be read, has another SHA-256 than `digest`, or holds anything but finite numbers.
    """
    try:
        data = path.read_bytes()
        tensors: dict[str, np.ndarray] = load(data)
    except OSError as error:
        raise CoopenvError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (SafetensorError, ValueError, KeyError) as error:
        raise CoopenvError(f"{path}: damaged, or no weights: {error}") from None
    if sha256(data).hexdigest() != digest:
        raise CoopenvError(f"{path}: not the weights that agent.toml was written with (another SHA-256)")
    if not all(values.dtype == np.float32 and np.isfinite(values).all() for values in tensors.values()):
        raise CoopenvError(f"{path}: weights are not finite numbers in float32")
    return tensors


def _depth_of(path: Path, tensors: Mapping[str, np.ndarray], inputs: int, outputs: int, spread: bool) -> int:
    """Return the number of layers. Raises CoopenvError: the weights are not those of a policy of such a width."""
    width = tensors[f"{MEMORY}{PARTS[-1]}"].size // 3 if f"{MEMORY}{PARTS[-1]}" in tensors else 0
    sizes = ((3 * width, inputs), (3 * width, width), (3 * width,), (3 * width,)) if width else ()
    remembered = {f"{MEMORY}{part}": shape for part, shape in zip(PARTS, sizes, strict=False)}
    names = {"observation.mean", "observation.std", *(["log_std"] if spread else []), *remembered}
    depth = (len(tensors) - len(names)) // 2
    expected = names | {f"layers.{i}.{part}" for i in range(depth) for part in ("weight", "bias")}
    if set(tensors) != expected or depth < 1:
        raise CoopenvError(f"{path}: not the weights of a policy: {', '.join(sorted(set(tensors) ^ expected))[:80]}")
    widths = [inputs + width, *(tensors[f"layers.{i}.bias"].size for i in range(depth - 1)), outputs]
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("observation.mean", "observation.std"), (inputs,)) | remembered
    for i, (before, after) in enumerate(pairwise(widths)):
        shapes |= {f"layers.{i}.weight": (after, before), f"layers.{i}.bias": (after,)}
    fits = all(tensors[name].shape == shape for name, shape in shapes.items())
    if not fits or not (tensors["observation.std"] > 0).all():
        raise CoopenvError(f"{path}: shapes do not fit {inputs} observations and {outputs} entries of an action")
    return depth
