"""TorchRL: a batch as one batched environment, rows (world, vehicle). Needs the extra `torchrl`."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorWrapper

from coopenv.api.make import make_vec
from coopenv.api.vector_env import CooperativeVectorEnv, TrueEnds
from coopenv.base.installation import install_command
from coopenv.scenario import ScenarioLike

try:
    from torchrl.envs import GymWrapper
except ImportError as error:
    raise ImportError(f"coopenv.api.trainers.torchrl needs TorchRL: {install_command('torchrl')}") from error


class WholeWorlds(VectorWrapper):
    """Resets worlds that are over, and no others, whatever rows TorchRL asks for.

    TorchRL resets a row as soon as it is done. Here a vehicle that has ended stays parked until its world is over; the
    world is then reset with the first of its rows that TorchRL wants to reset.
    """

    unwrapped: CooperativeVectorEnv

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """The batch's own, where TorchRL looks for it."""
        return self.unwrapped.autoreset_mode

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all worlds, or, under a `reset_mask`, those of its worlds that are over."""
        batch, mask = self.unwrapped, (options or {}).get("reset_mask")
        if mask is None:
            return self.env.reset(seed=seed, options=options)[0], {}
        wanted = batch.world_major(np.asarray(mask)).any(axis=1)
        over = wanted & (batch.engine.view("over") != 0)
        if over.any():
            return self.env.reset(seed=seed, options={"reset_mask": over})[0], {}
        return batch.engine.view("observation").reshape(self.num_envs, -1).copy(), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and keep infos to ourselves: TorchRL makes tensors of them."""
        return *self.env.step(actions)[:4], {}


def batched_env(name_or_path: ScenarioLike, *, num_worlds: int, **options: Any) -> GymWrapper:
    """Return num_worlds x vehicles rows as one TorchRL environment of that batch size, for a policy that they share.

    A row is done when its vehicle's episode ends, see `coopenv.api.vector_env.TrueEnds`.

    Args:
        name_or_path: as for `coopenv.make_vec`.
        num_worlds: how many worlds.
        options: whatever else `coopenv.make_vec` takes but `autoreset` and `arrays`.

    Raises:
        CoopenvError: any argument is not valid.
    """
    batch = make_vec(name_or_path, num_worlds=num_worlds, **options, autoreset="disabled", arrays="numpy")
    return GymWrapper(WholeWorlds(TrueEnds(batch)))
