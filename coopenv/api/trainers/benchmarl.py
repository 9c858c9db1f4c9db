"""BenchMARL: every environment as a task. Needs the extra `benchmarl`."""

from collections.abc import Callable, Iterator
from itertools import count, repeat
from typing import Any

from coopenv.api.make import parallel_env
from coopenv.api.parallel_env import NUMBERS, PlainInfos
from coopenv.base.installation import install_command
from coopenv.scenario import ScenarioLike, scenario_name

try:
    from benchmarl.environments.pettingzoo.common import PettingZooClass
    from torchrl.envs import EnvBase
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
except ImportError as error:
    raise ImportError(f"coopenv.api.trainers.benchmarl needs BenchMARL: {install_command('benchmarl')}") from error


class CooperativeTask(PettingZooClass):
    """One world per environment, all vehicles in the group `vehicle`; `task(name, **options)` builds it."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Return a maker of worlds, each with the next seed; BenchMARL makes `num_envs` and runs them in turn."""
        options = {k: v for k, v in self.config.items() if k != "env"}
        seeds: Iterator[int | None] = repeat(None) if seed is None else count(seed)
        return lambda: PettingZooWrapper(
            PlainInfos(parallel_env(self.config["env"], **options), with_absent=True),
            done_on_any=False,
            use_mask=True,
            return_state=True,
            seed=next(seeds),
            device=device,
        )

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        scenario = env.unwrapped.scenario
        return round(float(scenario.horizon * scenario.rates.decision))

    def has_render(self, env: EnvBase) -> bool:
        return bool(env.unwrapped.render_mode == "rgb_array")

    @staticmethod
    def env_name() -> str:
        return "coopenv"

    @staticmethod
    def log_info(batch: Any) -> dict[str, float]:
        """Return means over the vehicles under way, and how many arrived and collided."""
        alive = batch["vehicle", "mask"]
        info = batch["next", "vehicle", "info"]
        events = ("arrived", "collided")
        return {
            f"collection/{name}": float(info[name][alive].sum() if name in events else info[name][alive].mean())
            for name in NUMBERS
        }


def task(name_or_path: ScenarioLike, **options: Any) -> CooperativeTask:
    """Return an environment as a task for `benchmarl.experiment.Experiment`.

    Args:
        name_or_path: for example "urban_crossing".
        options: those of `coopenv.parallel_env`.
    """
    return CooperativeTask(name=scenario_name(name_or_path), config={"env": name_or_path, **options})
