"""Cloning a planner in many environments at once into a network over sets; see `coopenv.policies.sets`."""

from collections.abc import Callable
from itertools import pairwise
from time import monotonic, process_time

import numpy as np
import torch
from torch import nn

from coopenv.base.errors import CoopenvError
from coopenv.policies.sets import CONSTANTS, HEAD_LAYERS, LAYERS, METRES, SETS, SetDriver
from coopenv.scenario import Scenario
from coopenv.training.batches import APART
from coopenv.training.settings import Clone, TrainingPlan
from coopenv.training.trainer import Status, regress, watch

UNSEEN = 1e6
"""Standard deviation of an input that never changes in training: it has no effect."""


class SetNetwork(nn.Module):
    """The network in torch, for the regression; `SetDriver.steer` is the same in NumPy."""

    def __init__(self, alone: int, rows: tuple[int, ...], hidden: int) -> None:
        """Build it for so many inputs of the vehicle itself, and columns of each set's rows."""
        super().__init__()
        half = hidden // 2
        widths = {name: [columns + alone, *[half] * LAYERS] for name, columns in zip(SETS, rows, strict=True)}
        widths["head"] = [alone + 2 * half * len(SETS), *[hidden] * (HEAD_LAYERS - 1), 1]
        self._parts = {name: [nn.Linear(*pair) for pair in pairwise(own)] for name, own in widths.items()}
        for name, layers in self._parts.items():
            self.add_module(name, nn.ModuleList(layers))

    def forward(self, alone: torch.Tensor, *sets: torch.Tensor) -> torch.Tensor:
        """Return steering angles, (rows,) in rad, for normalised inputs."""
        parts = [alone]
        for name, rows in zip(SETS, sets, strict=True):
            hidden = torch.cat([rows, alone[:, None].expand(-1, rows.shape[1], -1)], dim=-1)
            for layer in self._parts[name]:
                hidden = torch.relu(layer(hidden))
            hidden = hidden * rows[..., :1]
            parts += [hidden.sum(dim=1) / METRES, hidden.amax(dim=1)]
        values = torch.cat(parts, dim=1)
        *layers, last = self._parts["head"]
        for layer in layers:
            values = torch.relu(layer(values))
        return torch.squeeze(last(values), 1)


class SetTrainer:
    """A clone in the worlds of many environments, and the data of its agent's folder."""

    def __init__(self, plan: TrainingPlan, scenario: Scenario, clone: Clone, threads: int | None = None) -> None:
        """Store the plan.

        Args:
            plan: the plan of the training.
            scenario: of the environment that it is judged in.
            clone: the settings of the clone.
            threads: shares of the batch on the CPU.

        Raises:
            CoopenvError: an observation lacks what the network reads.
        """
        torch.set_num_threads(1)
        self.plan, self.scenario, self.clone, self.threads = plan, scenario, clone, threads or 1
        self.teacher = clone.agents[0]
        self.tensors: dict[str, np.ndarray] = {}
        """The weights, float32."""
        self.seen: dict[str, tuple[float, float]] = {}
        """Between which values the constants of the training lay."""
        worlds = [(own.environment, *pair) for own in plan.watched() for pair in own.scenarios(clone.episodes)]
        try:
            self.mean_action = SetDriver(scenario, self.tensors)
            """The driver in the environment that it is judged in; with weights after `begin`."""
            self._worlds = [(name, each, count, SetDriver(each, {})) for name, each, count in worlds]
        except ValueError as error:
            raise CoopenvError(f"network: {error}") from None
        self.seconds, self.cpu_seconds = 0.0, 0.0

    def begin(self, report: Callable[[str], None]) -> None:
        """Watch the planner and learn its steering."""
        begin, cpu_begin = monotonic(), process_time()
        watched = []
        for place, (name, each, count, driver) in enumerate(self._worlds):
            title = f"{name} ({place + 1} of {len(self._worlds)}): "

            def titled(line: str, title: str = title) -> None:
                report(title + line)

            watched.append(self._watched(each, count, driver, APART * place, titled))
        alone, *rest = (_joined(parts) for parts in zip(*watched, strict=True))
        std = alone.std(axis=0)
        scales = {"mean": alone.mean(axis=0), "std": np.where(std > 1e-4 * np.abs(alone).max(axis=0), std, UNSEEN)}
        for place, name in enumerate(CONSTANTS, alone.shape[1] - len(CONSTANTS)):
            self.seen[name] = (round(float(alone[:, place].min()), 4), round(float(alone[:, place].max()), 4))
        inputs = [torch.from_numpy(values) for values in ((alone - scales["mean"]) / scales["std"], *rest)]
        torch.manual_seed(self.plan.seed)
        widths = tuple(rows.shape[-1] for rows in inputs[1:-1])
        network = SetNetwork(alone.shape[1], widths, self.plan.settings.ppo.hidden[0])

        def loss(*columns: torch.Tensor) -> torch.Tensor:
            *seen, steering = columns
            return nn.functional.smooth_l1_loss(network(*seen), steering, beta=0.1)

        regress(network.parameters(), inputs, self.clone, self.plan.seed, loss, report)
        learnt = {name: values.numpy() for name, values in network.state_dict().items()}
        self.tensors = {name: np.asarray(values, dtype=np.float32) for name, values in {**scales, **learnt}.items()}
        self.mean_action = SetDriver(self.scenario, self.tensors)
        self.seconds, self.cpu_seconds = monotonic() - begin, process_time() - cpu_begin

    def _watched(
        self, scenario: Scenario, worlds: int, driver: SetDriver, apart: int, report: Callable[[str], None]
    ) -> tuple[np.ndarray, ...]:
        """Return inputs, and the planner's steering, (rows,) in rad, in worlds of a scenario."""
        seed, gamma = self.plan.seed + apart, self.plan.settings.ppo.discount(scenario)
        seen, actions, _, vehicle = watch(scenario, worlds, self.clone, gamma, seed, self.threads, report)
        steering = driver.layout.action[1].high * actions[:, 1]
        return *driver.inputs(seen, vehicle), steering.astype(np.float32)

    @property
    def status(self) -> Status:
        """Progress of the training."""
        return Status(0, self.seconds, 1.0, {})


def _joined(parts: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return arrays one after the other; sets, (rows, K, columns), with empty rows up to the largest K."""
    if parts[0].ndim < 3:
        return np.concatenate(parts)
    most = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(part, ((0, 0), (0, most - part.shape[1]), (0, 0))) for part in parts])
