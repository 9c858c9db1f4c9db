"""BenchMARL: every environment as a task, batched. Needs the extra `benchmarl`.

Copy this file and `torchrl_env.py` beside your program; docs/trainers.md has one.
"""

from typing import Any

from coopenv.base.installation import install_command
from coopenv.scenario import ScenarioLike, scenario_name

try:
    from benchmarl.environments.vmas.common import VmasClass
    from tensordict import TensorDictBase
    from torchrl.data import Composite
    from torchrl.envs import EnvBase, Transform
    from torchrl_env import EVENTS, GROUP, QUALITIES, batched_env
except ImportError as error:
    raise ImportError(f"{__name__} needs BenchMARL: {install_command('benchmarl')}") from error


class ActingLosses(Transform):
    """Takes the rows of vehicles that did not act out of the losses of PPO: no advantage, no error of the critic."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Change a sample of the replay buffer; one without advantages stays."""
        rows, mask = tensordict[GROUP], tensordict[GROUP, "mask"].unsqueeze(-1)
        if rows.get("advantage", None) is not None:
            rows["advantage"] = rows["advantage"] * mask
            rows["value_target"] = rows["value_target"].where(mask, rows["state_value"])
        return tensordict


class CooperativeTask(VmasClass):
    """A batch of worlds, like VMAS's; `task(name, ...)` builds it."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Any:
        """Return a maker of `num_envs` worlds in a batch."""
        return lambda: batched_env(num_worlds=num_envs, seed=seed, device=str(device), **self.config)

    def supports_discrete_actions(self) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        return round(float(env.scenario.horizon * env.scenario.rates.decision))

    def has_render(self, env: EnvBase) -> bool:
        return bool(env.batch.render_mode == "rgb_array")

    def observation_spec(self, env: EnvBase) -> Composite:
        spec = env.full_observation_spec_unbatched[GROUP]
        return Composite({GROUP: Composite({"observation": spec["observation"].clone()}, shape=spec.shape)})

    def state_spec(self, env: EnvBase) -> Composite:
        return Composite({"state": env.full_observation_spec_unbatched["state"].clone()})

    def get_replay_buffer_transforms(self, env: EnvBase, group: str) -> list[Transform]:
        return [ActingLosses()]

    @staticmethod
    def env_name() -> str:
        return "coopenv"

    @staticmethod
    def log_info(batch: Any) -> dict[str, float]:
        """Return means over the vehicles under way, and how many arrived and collided."""
        alive, info = batch[GROUP, "mask"], batch["next", GROUP, "info"]
        means = {name: info[name][alive].mean() for name in QUALITIES}
        sums = {name: info[name].sum() for name in EVENTS}
        return {f"collection/{name}": float(value) for name, value in {**means, **sums}.items()}


def task(name_or_path: ScenarioLike, **options: Any) -> CooperativeTask:
    """Return an environment as a task for `benchmarl.experiment.Experiment`.

    Args:
        name_or_path: for example "urban_crossing".
        options: options of `coopenv.make_vec` but `num_worlds`, `device`, `autoreset`, `arrays` and `observation`.
            `render_mode="rgb_array"` and `ExperimentConfig.render` make films of evaluations.
    """
    return CooperativeTask(name=scenario_name(name_or_path), config={"name_or_path": name_or_path, **options})
