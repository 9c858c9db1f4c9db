"""Methods that learn from recordings alone: episodes of a scripted driver in a Minari dataset, cloned or by TD3+BC."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import minari
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate, TD3BCLoss

from coopenv.api.registration import registered_spec
from coopenv.base.sections import Section
from coopenv.policies import Policy, load_agent, restart
from coopenv.runs.exports import DrivenEpisode, dataset_place, drive_vehicles, write_dataset
from coopenv.sources.sources import open_simulation

WORLDS = 32
"""Driven at once for a dataset."""
LEAST_STD = 1e-2
"""Added to standard deviations of observations: what hardly changes is not blown up."""


class Offline(Section):
    """Learning from a dataset."""

    algorithm: Literal["clone", "td3_bc"]
    """`clone`: least squares of the actions; `td3_bc`: Fujimoto and Gu 2021."""
    hidden: int = 128
    """Units of each of two hidden layers (tanh)."""
    gradient_steps: int = 6_000
    minibatch: int = 512
    """Decisions of vehicles."""
    learning_rate: float = 1e-3
    """Of Adam at first; falls to zero."""
    gamma: float = 0.99
    target_rate: float = 0.005
    """Share of the present networks in their targets, per gradient step."""
    alpha: float = 2.5
    """Weight of the value against the least squares."""


class Noisy:
    """A driver whose actions are disturbed, so that its corrections are recorded."""

    def __init__(self, driver: Policy, noise: float, seed: int) -> None:
        self.driver, self.noise, self.random = driver, noise, np.random.default_rng(seed)

    def reset(self, mask: np.ndarray) -> None:
        """Forget what was seen in rows where an episode begins."""
        restart(self.driver, mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the driver's actions plus normal noise, (rows, A)."""
        actions = np.asarray(self.driver(observations))
        return np.clip(actions + self.noise * self.random.standard_normal(actions.shape), -1.0, 1.0)


def recorded(environment: str, agent: str, decisions: int, noise: float, folder: Path) -> Path:
    """Return the folder of a Minari dataset of so many decisions of vehicles under way, written unless it is there."""
    identity = f"methods/{environment}-{agent}-{decisions}-{round(1000 * noise)}-v0"
    if (there := folder / identity / "data").is_dir():
        return there
    place, scenario = dataset_place(identity, folder, force=True), open_simulation(environment, {})
    episodes: list[DrivenEpisode] = []
    seed = 0
    while (missing := decisions - sum(len(episode.actions) for episode in episodes)) > 0:
        driven = drive_vehicles(scenario, Noisy(load_agent(agent, scenario), noise, seed), seed, WORLDS)
        longest = np.cumsum([len(episode.actions) for episode in driven])
        episodes += driven[: int(np.searchsorted(longest, missing)) + 1]
        seed += 1
    facts = {"algorithm_name": agent, "description": f"{environment}: {agent} with noise {noise} on its actions"}
    write_dataset(episodes, scenario, registered_spec(environment), place, identity, facts)
    return there


def transitions(folder: Path) -> TensorDict:
    """Return all decisions of a dataset, (rows,), with those that follow under `next`."""
    parts = []
    for episode in minari.MinariDataset(folder):
        ended, cut = (torch.from_numpy(each)[:, None] for each in (episode.terminations, episode.truncations))
        seen = torch.from_numpy(episode.observations)
        after = {
            "observation": seen[1:],
            "reward": torch.from_numpy(episode.rewards).float()[:, None],
            "terminated": ended,
            "done": ended | cut,
        }
        rows = {"observation": seen[:-1], "action": torch.from_numpy(episode.actions), "next": after}
        parts.append(TensorDict(rows, [len(episode.actions)]))
    return torch.cat(parts)


class Normalised:
    """Drives by a network on normalised observations."""

    def __init__(self, network: nn.Module, mean: torch.Tensor, std: torch.Tensor) -> None:
        self.network, self.mean, self.std = network, mean, std

    @torch.no_grad()
    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return actions, (rows, A)."""
        rows = torch.from_numpy(np.asarray(observations, dtype=np.float32))
        return np.asarray(self.network((rows - self.mean) / self.std))


def learn(rows: TensorDict, seed: int, options: dict[str, Any]) -> Policy:
    """Learn from the decisions of a dataset."""
    asked = Offline(**options)
    torch.manual_seed(seed)
    mean, std = rows["observation"].mean(0), rows["observation"].std(0) + LEAST_STD
    scaled = rows.clone()
    for part in (scaled, scaled["next"]):
        part["observation"] = (part["observation"] - mean) / std
    wide, narrow = rows["observation"].shape[1], rows["action"].shape[1]
    layers: dict[str, Any] = {"num_cells": [asked.hidden] * 2, "activation_class": nn.Tanh}
    network = nn.Sequential(MLP(in_features=wide, out_features=narrow, **layers), nn.Tanh())
    improve = _td3_bc if asked.algorithm == "td3_bc" else _clone
    step, parameters = improve(asked, network, MLP(in_features=wide + narrow, out_features=1, **layers), narrow)
    optimiser = torch.optim.Adam(parameters, asked.learning_rate)
    for number in range(asked.gradient_steps):
        optimiser.param_groups[0]["lr"] = asked.learning_rate * (1.0 - number / asked.gradient_steps)
        optimiser.zero_grad()
        step(scaled[torch.randint(len(scaled), (asked.minibatch,))]).backward()
        optimiser.step()
    return Normalised(network, mean, std)


Step = tuple[Callable[[TensorDictBase], torch.Tensor], list[nn.Parameter]]
"""The loss of a minibatch, and the parameters that it is minimised over."""


def _clone(asked: Offline, network: nn.Module, value: nn.Module, width: int) -> Step:
    def loss(rows: TensorDictBase) -> torch.Tensor:
        return nn.functional.mse_loss(network(rows["observation"]), rows["action"])

    return loss, list(network.parameters())


def _td3_bc(asked: Offline, network: nn.Module, value: nn.Module, width: int) -> Step:
    actor = TensorDictModule(network, in_keys=["observation"], out_keys=["action"])
    bounds = (-torch.ones(width), torch.ones(width))
    losses = TD3BCLoss(
        actor, ValueOperator(value, ["observation", "action"]), bounds=bounds, alpha=asked.alpha, deactivate_vmap=True
    )
    losses.make_value_estimator(gamma=asked.gamma)
    targets = SoftUpdate(losses, tau=asked.target_rate)

    def loss(rows: TensorDictBase) -> torch.Tensor:
        targets.step()
        found = losses(rows)
        return torch.as_tensor(found["loss_actor"] + found["loss_qvalue"])

    return loss, [each for each in losses.parameters() if each.requires_grad]
