"""TorchRL: a batch of worlds as one environment with a group of agents. Needs the extra `torchrl` or `benchmarl`.

Copy this file beside your program; docs/trainers.md has one.
"""

from typing import Any

import numpy as np

from coopenv.api.arguments import STATE_LIMIT, world_states
from coopenv.api.make import make_vec
from coopenv.api.vector_env import CooperativeVectorEnv
from coopenv.base.installation import install_command
from coopenv.estimation import Outcome
from coopenv.scenario import ScenarioLike
from coopenv.world.reset import ABSENT

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError(f"{__name__} needs TorchRL: {install_command('torchrl')}") from error

GROUP = "vehicle"
QUALITIES = ("position_error", "orientation_error", "nees")
FLAGS = ("done", "terminated", "truncated")
EVENTS = {"arrived": Outcome.ARRIVED, "collided": Outcome.COLLIDED}


class BatchedWorlds(EnvBase):
    """W worlds, batch size (W,), with their N agents as the group `vehicle`, and `state` (W, S) for central critics.

    - `vehicle`: `observation`, `reward`, `info` (errors in m and deg, NEES, 1 in the step of an arrival or collision),
      and `mask`, true for vehicles under way (with a team reward, of the team): those that act. Other rows are 0, and
      `done` until the world is over.
    - A vehicle is `terminated` when it ends, and if it is absent in the episode; `truncated` at the horizon.
    - A world is `done` when all of its vehicles are, and `terminated` if all of them are. TorchRL then resets it by
      `_reset`, (W, 1), alone.

    Agents are those of `coopenv.parallel_env`. `set_seed` fixes the episodes from the next reset of all worlds on.
    """

    def __init__(self, batch: CooperativeVectorEnv) -> None:
        """Take a batch with autoreset "disabled" and NumPy arrays; `batched_env` makes one."""
        scenario, worlds = batch.scenario, batch.num_worlds
        super().__init__(device=batch.engine.world.device, batch_size=[worlds])
        self.batch, self.scenario = batch, scenario
        self._seed: int | None = None
        self._agents = scenario.agents()
        self.group_map = {GROUP: [scenario.vehicle_names[i] for i in self._agents]}
        rows = (worlds, len(self._agents))
        self._going = torch.zeros(rows, dtype=torch.bool, device=self.device)
        space: Any = batch.single_observation_space

        def group(**fields: Any) -> Composite:
            return Composite({GROUP: Composite(fields, shape=rows)}, shape=rows[:1])

        low, high = (torch.tensor(bound).expand(*rows, -1) for bound in (space.low, space.high))
        self.observation_spec = group(
            observation=Bounded(low, high, dtype=torch.float32),
            mask=Categorical(2, rows, dtype=torch.bool),
            info=Composite({name: Unbounded(rows) for name in (*QUALITIES, *EVENTS)}, shape=rows),
        )
        self.observation_spec["state"] = Bounded(
            -STATE_LIMIT, STATE_LIMIT, (worlds, *world_states(batch.engine.view, scenario).shape[1:])
        )
        self.action_spec = group(action=Bounded(-1.0, 1.0, (*rows, scenario.action_size)))
        self.reward_spec = group(reward=Unbounded((*rows, 1)))
        self.done_spec = group(**{name: Categorical(2, (*rows, 1), dtype=torch.bool) for name in FLAGS})
        self.done_spec.update({name: Categorical(2, (worlds, 1), dtype=torch.bool) for name in FLAGS})
        self.to(self.device)

    def render(self) -> np.ndarray:
        """Return the top view of the first world, (H, W, 3) uint8."""
        return self.batch.engine.picture()

    def close(self, **options: Any) -> None:
        """End the threads of the worlds."""
        self.batch.close()
        super().close(**options)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def _field(self, name: str) -> torch.Tensor:
        """Return a copy of a field of the agents, (W, N, ...)."""
        return torch.as_tensor(self.batch.engine.view(name)[:, self._agents], device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        mask: Any = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or mask.all():
            self.batch.reset(seed=self._seed)
            self._seed, mask = None, torch.ones_like(self._going)
        else:
            self.batch.reset(options={"reset_mask": mask.flatten().cpu().numpy()})
        self._going = torch.where(mask.view(len(mask), -1), self._field("ended") != ABSENT, self._going)
        return self._results(self._going, {})

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        acted, given = self._going[..., None], tensordict[GROUP, "action"]
        actions = self.batch.engine.view("actions").copy()
        actions[:, self._agents] = torch.where(acted, given, self._field("actions")).cpu().numpy()
        self.batch.step(actions)
        truncated = acted & self._field("truncated")[..., None]
        going = acted & ~self._field("terminated")[..., None] & ~truncated
        self._going = going[..., 0]
        flags = {"done": ~going, "terminated": ~going & ~truncated, "truncated": truncated}
        found = self._results(acted[..., 0], flags)
        found[GROUP, "reward"] = torch.where(acted, self._field("reward")[..., None], 0.0)
        done, terminated = (flags[name].all(dim=1) for name in ("done", "terminated"))
        return found.update({"done": done, "terminated": terminated, "truncated": done & ~terminated})

    def _results(self, acted: torch.Tensor, flags: dict[str, torch.Tensor]) -> TensorDict:
        """Return the agents' entries, 0 in the rows (W, N) that have not acted; with flags (W, N, 1) of acting."""
        ended, fresh = self._field("ended"), self._field("under_way")
        info = {name: self._field(name).float() for name in QUALITIES}
        info |= {name: (fresh & (ended == code)).float() for name, code in EVENTS.items()}
        group = {
            "observation": torch.where(acted[..., None], self._field("observation"), 0.0),
            "mask": self._going,
            "info": TensorDict({name: torch.where(acted, each, 0.0) for name, each in info.items()}, acted.shape),
            **flags,
        }
        state = torch.as_tensor(self.batch.state(), device=self.device)
        return TensorDict({GROUP: TensorDict(group, acted.shape), "state": state}, self.batch_size, device=self.device)


def batched_env(
    name_or_path: ScenarioLike, *, num_worlds: int, seed: int | None = None, **options: Any
) -> BatchedWorlds:
    """Return a batch of worlds as one TorchRL environment.

    Args:
        name_or_path: as for `coopenv.make_vec`.
        num_worlds: number of worlds.
        seed: seed of the batch; None: a training seed is drawn.
        options: whatever else `coopenv.make_vec` takes but `autoreset`, `arrays` and `observation`.

    Raises:
        CoopenvError: any argument is not valid.
    """
    fixed: dict[str, Any] = {"autoreset": "disabled", "arrays": "numpy", "observation": "flat"}
    env = BatchedWorlds(make_vec(name_or_path, num_worlds=num_worlds, **options, **fixed))
    env.set_seed(seed)
    return env
