"""Stable-Baselines3: the batch as a native `VecEnv`, rows (world, vehicle), and a faster PPO. Needs the extra `train`.

PPO has the gradients of its networks in closed form; results are those of SB3's `PPO`, except for rounding. The update
takes less CPU time: tanh is NumPy's, and on AMD matrices are multiplied by oneDNN.
"""

import copy
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.api.arguments import outcome_words
from coopenv.api.engine import Engine
from coopenv.api.make import make_vec
from coopenv.api.terms.layout import Layout
from coopenv.api.vector_env import CooperativeVectorEnv, RecordVehicleEpisodes
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command
from coopenv.base.seeds import checked_seed
from coopenv.estimation import Outcome
from coopenv.scenario import ScenarioLike

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.buffers import RolloutBuffer
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.type_aliases import RolloutBufferSamples
    from stable_baselines3.common.utils import explained_variance
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
    from torch import Tensor, nn
except ImportError as error:
    raise ImportError(f"coopenv.api.trainers.sb3 needs stable-baselines3: {install_command('train')}") from error

AT_THE_END = ("position_error", "orientation_error", "nees", "log_determinant", "gramian_min_eigenvalue", "time")
"""Fields of the batch's infos that a row's info holds when its episode ends."""


class CooperativeSB3VecEnv(VecEnv):
    """All vehicles of all worlds as rows of one batch, for a policy that they share.

    A row is done when its vehicle's episode truly ends: at its arrival or collision, or under way at the end of its
    world. `infos[row]` then holds

    - `terminal_observation`, and `TimeLimit.truncated`: whether the value beyond it counts;
    - `episode`: `r`, the undiscounted return, `l`, decisions, and `t`, s since the environment was made, which SB3
      shows as `ep_rew_mean` and `ep_len_mean` without a monitor;
    - `is_success` (arrived; SB3 shows its `success_rate`), `outcome`, `reward_terms` (sums over the episode), and
      `position_error` (m), `orientation_error` (deg), `nees`, `log_determinant`, `gramian_min_eigenvalue`, `time` (s).

    A vehicle that ended before its world stays parked with reward 0, and its row is not done once more when the world
    is over: to SB3 the time until then is the beginning of its next episode, in which nothing that it does counts. So
    every done is an episode, and `VecMonitor` and `evaluate_policy` find the true returns; lengths that they count
    themselves hold the time parked too. `acted` says which rows were under way in the last step; `ActingRowsBuffer`
    lets PPO learn from these alone.

    In other steps infos are empty. Infos of the whole batch at every step are in `batch_infos`, arrays by name.
    """

    def __init__(self, envs: CooperativeVectorEnv) -> None:
        """Show a batch with the autoreset mode SAME_STEP and NumPy arrays; `make_sb3_vec_env` builds one by name."""
        self.envs = envs
        batch = envs.unwrapped
        self.scenario, self.vehicles = batch.scenario, batch.vehicles
        self.render_mode, self.metadata = "rgb_array", envs.metadata
        self.acted = np.zeros(envs.num_envs, dtype=bool)
        """(num_envs,) whether the row's vehicle was under way in the last step, and acts (any, where none does).

        With a team reward a vehicle that has arrived is no longer under way, although its episode goes on."""
        self._parked = np.zeros(envs.num_envs, dtype=bool)
        self.batch_infos: dict[str, Any] = {}
        """Infos of the last step as `CooperativeVectorEnv` gives them, arrays (num_envs,)."""
        self._recorder = RecordVehicleEpisodes(envs)
        self._driver: Any = getattr(envs, "driver", None)  # of `ChoiceRows`
        self.kept: int = self._driver.kept if self._driver else 1
        """Decisions of a step."""
        self._rows = batch.acting if batch.acting.any() else ~batch.acting
        self._outcomes, self._begin = outcome_words(batch.scenario), time.time()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    @property
    def engine(self) -> Engine:
        """The engine of the batch; a copy of a batch builds its own."""
        return self.envs.unwrapped.engine

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of an observation row."""
        return self.envs.unwrapped.observation_layout

    def reset(self) -> Any:
        """Start a new episode in every world; `seed()` and `set_options()` apply once.

        Options are those of `CooperativeVectorEnv.reset`; its settings hold until they are given again.
        """
        observation, self.batch_infos = self._recorder.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._parked = self.batch_infos["ended"] != Outcome.UNDER_WAY
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return observation

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the state of the next step as arrays, for `set_state`; plug-in observers are not supported."""
        remembered = {f"driver.{i}": values for i, values in enumerate(self._driver.state if self._driver else ())}
        return {**self.engine.get_state(), "episode_sums": self._recorder.sums.copy(), **remembered}

    def set_state(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """Continue from a state of `get_state`, and return its observations.

        Raises:
            CoopenvError: it does not fit.
        """
        rest = dict(state)
        sums = rest.pop("episode_sums")
        if sums.shape != self._recorder.sums.shape or not np.isfinite(sums).all():
            raise CoopenvError(f"sums of episodes: expected finite numbers of shape {self._recorder.sums.shape}")
        if self._driver:
            self._driver.state = [rest.pop(f"driver.{i}").copy() for i in range(len(self._driver.state))]
        self.engine.set_state(rest)
        self._recorder.sums[...] = sums
        self._parked = self.engine.view("ended").reshape(-1) != Outcome.UNDER_WAY
        return self.engine.view("observation").reshape(self.num_envs, -1).copy()

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions, (num_envs, A)."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Drive for one decision period and reset the worlds that are over.

        Raises:
            ActionError: actions of a wrong shape, or not finite.
        """
        observation, rewards, _, truncated, after = self._recorder.step(self._actions)
        self.batch_infos = step = after.get("final_info", after)
        self.acted = step["alive"] & self._rows & ~self._parked
        self._parked = after["ended"] != Outcome.UNDER_WAY
        dones = after.get("_episode", np.zeros(self.num_envs, dtype=bool)) & self._rows
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(dones).tolist():
            episode, final = after["episode"], after["final_obs"]
            flat = not isinstance(final, dict)
            counts = {"r": float(episode["r"][row]), "l": int(episode["l"][row])}
            infos[row] = {
                "terminal_observation": final[row] if flat else {name: part[row] for name, part in final.items()},
                "TimeLimit.truncated": bool(truncated[row]),
                "episode": {**counts, "t": round(time.time() - self._begin, 6)},
                "is_success": bool(step["ended"][row] == Outcome.ARRIVED),
                "outcome": self._outcomes[step["ended"][row]],
                "reward_terms": {name: float(values[row]) for name, values in episode["reward_terms"].items()},
                **{name: float(step[name][row]) for name in AT_THE_END},
            }
        return observation, rewards, dones, infos

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset, as for `CooperativeVectorEnv.reset`.

        Raises:
            CoopenvError: not a whole number, or negative.
        """
        return list(super().seed(None if seed is None else checked_seed(seed)))

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return one picture, the top view of world 0."""
        return [self.engine.picture()]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch, which all rows share.

        Raises:
            CoopenvError: only some rows are named.
        """
        self._all(indices, f"set_attr('{attr_name}')")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once and return its result once per row.

        Raises:
            CoopenvError: only some rows are named.
        """
        self._all(indices, f"env_method('{method_name}')")
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return True per row for SB3's `Monitor`, whose `info["episode"]` the rows give themselves; else False."""
        return [wrapper_class is Monitor] * len(list(self._get_indices(indices)))

    def __copy__(self) -> "CooperativeSB3VecEnv":
        return copy.deepcopy(self)

    def _all(self, indices: VecEnvIndices, what: str) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise CoopenvError(f"{what}: rows share one batch, so it cannot be done for some rows only")


def make_sb3_vec_env(name_or_path: ScenarioLike, *, seed: int | None = None, **options: Any) -> CooperativeSB3VecEnv:
    """Return num_worlds x vehicles rows as an SB3 `VecEnv`.

    Args:
        name_or_path: as for `coopenv.make_vec`.
        seed: of the first reset, as for `CooperativeVectorEnv.reset`.
        options: `num_worlds` and whatever else `coopenv.make_vec` takes but `autoreset` and `arrays`, which are those
            that SB3 expects.

    Raises:
        CoopenvError: any argument is not valid.
    """
    if isinstance(name_or_path, CooperativeVectorEnv):
        raise CoopenvError("make_sb3_vec_env takes the arguments of make_vec; for a batch: CooperativeSB3VecEnv(batch)")
    for name in ("autoreset", "arrays"):
        if name in options:
            raise CoopenvError(f"make_sb3_vec_env chooses {name} itself: SB3 resets in the same step and takes NumPy")
    env = CooperativeSB3VecEnv(make_vec(name_or_path, **options, autoreset="same_step", arrays="numpy"))
    if seed is not None:
        env.seed(seed)
    return env


class ActingRowsBuffer(RolloutBuffer):
    """Gives PPO minibatches of the rows of vehicles under way alone; flat observations only.

        model = PPO("MlpPolicy", env, rollout_buffer_class=ActingRowsBuffer, rollout_buffer_kwargs={"rows": env})

    Advantages need no correction: a row is done when its vehicle's episode ends, so nothing of the time parked reaches
    back to before it.
    """

    def __init__(self, *arguments: Any, rows: CooperativeSB3VecEnv, **options: Any) -> None:
        """Build the buffer.

        Args:
            *arguments: arguments of SB3's `RolloutBuffer`.
            rows: the environment that the rollouts come from, without its wrappers.
            **options: options of SB3's `RolloutBuffer`.
        """
        self._rows = rows
        super().__init__(*arguments, **options)

    def reset(self) -> None:
        """Remove the collected steps."""
        self.generator_ready = False
        self.acted = np.zeros((self.buffer_size, self.n_envs), dtype=bool)
        super().reset()

    def add(self, *step: Any, **named: Any) -> None:
        """Add a step, and which vehicles were under way in it."""
        self.acted[self.pos] = self._rows.acted
        super().add(*step, **named)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Yield shuffled minibatches of about `batch_size` rows each, all as large as one another."""
        if not self.generator_ready:
            for name in ("observations", "actions", "values", "log_probs", "advantages", "returns"):
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        for part in self.parts(batch_size or max(1, int(self.acted.sum()))):
            yield self._get_samples(part)

    def parts(self, batch_size: int) -> Iterator[np.ndarray]:
        """Yield the numbers of the rows of each minibatch."""
        chosen = np.random.permutation(np.flatnonzero(self.swap_and_flatten(self.acted)))
        for part in np.array_split(chosen, max(1, round(len(chosen) / batch_size))):
            if len(part):
                yield part


ONEDNN: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None)  # private to torch
CPUINFO = Path("/proc/cpuinfo")


@cache
def onednn_pays() -> bool:
    """Return whether oneDNN's products are faster than torch's own, those of MKL.

    On AMD MKL uses half the width of the vector units; on Intel oneDNN's products take up to twice as long.
    """
    amd = CPUINFO.exists() and "AuthenticAMD" in CPUINFO.read_text(encoding="utf-8")
    return amd and ONEDNN is not None and torch.backends.mkldnn.is_available()


def product(rows: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return rows (R, D) times the transpose of weight (A, D), plus bias (A,)."""
    if onednn_pays():
        found: Tensor = ONEDNN(rows, weight, bias, "none", [], "")
        return found
    return nn.functional.linear(rows, weight, bias)


class TanhNetwork(torch.autograd.Function):
    """A tanh network with derivatives in closed form; `apply` it to its layers, rows (rows, D) and its parameters."""

    @staticmethod
    def forward(ctx: Any, layers: Sequence[nn.Linear], rows: Tensor, *parameters: Tensor) -> Tensor:
        """Return the output (rows, A)."""
        ctx.layers, ctx.inputs = layers, list[Tensor]()
        for layer in layers:
            ctx.inputs.append(rows)
            rows = product(rows, layer.weight, layer.bias)
            if layer is not layers[-1]:
                np.tanh(rows.numpy(), out=rows.numpy())  # torch's takes ten times as long
        return rows

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Any:
        """Return a loss's derivatives with respect to rows and parameters, from that with respect to the output."""
        found = list[Tensor]()
        for layer, inputs in zip(reversed(ctx.layers), reversed(ctx.inputs), strict=True):
            found += [slope.sum(0), product(slope.t(), inputs.t())]
            if layer is not ctx.layers[0]:
                slope = torch.ops.aten.tanh_backward(product(slope, layer.weight.t()), inputs)
        through = product(slope, ctx.layers[0].weight.t()) if ctx.needs_input_grad[1] else None
        return None, through, *reversed(found)


def network(layers: Sequence[nn.Linear], rows: Tensor) -> Tensor:
    """Return the output (rows, A) of a tanh network, which can be differentiated."""
    parameters = (part for layer in layers for part in (layer.weight, layer.bias))
    output: Tensor = TanhNetwork.apply(layers, rows, *parameters)
    return output


class TanhPolicy(ActorCriticPolicy):
    """SB3's `MlpPolicy` on the CPU: a tanh network for the mean action or the logits of letters, one for the value."""

    critic_alone = False
    """Whether the loss depends on the values alone."""

    @property
    def spread(self) -> dict[str, nn.Parameter]:
        """Parameters of the distribution of actions beside the networks', by name."""
        return {"log_std": self.log_std} if hasattr(self, "log_std") else {}

    def layers(self) -> tuple[list[nn.Linear], list[nn.Linear]]:
        """Return the layers of the networks for the mean and for the value."""
        networks: tuple[tuple[Any, Any], ...] = (
            (self.mlp_extractor.policy_net, self.action_net),
            (self.mlp_extractor.value_net, self.value_net),
        )
        actor, critic = ([*(part for part in net if isinstance(part, nn.Linear)), end] for net, end in networks)
        return actor, critic

    def _distribution(self, obs: Tensor) -> Any:
        return self.action_dist.proba_distribution(network(self.layers()[0], obs), *self.spread.values())

    @torch.no_grad()
    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (rows, A) or letters (rows,), values (rows, 1) and logarithms of their densities (rows,)."""
        distribution = self._distribution(obs)
        actions = distribution.get_actions(deterministic)
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    def evaluate_actions(self, obs: Any, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (rows, 1), and logarithms of the actions' densities and entropies (rows,), for the loss."""
        distribution = self._distribution(obs)
        log_density, entropy = distribution.log_prob(actions), distribution.entropy()
        if self.critic_alone:
            log_density, entropy = log_density.detach(), entropy.detach()
        return network(self.layers()[1], obs), log_density, entropy

    @torch.no_grad()
    def predict_values(self, obs: Any) -> Tensor:
        """Return values, (rows, 1)."""
        return network(self.layers()[1], obs)


class LeanPpo(PPO):
    """SB3's `PPO` for a `TanhPolicy`, whose critic may learn alone."""

    policy: TanhPolicy
    rollout_buffer: ActingRowsBuffer
    critic_alone = False
    """Whether the critic alone learns, and the policy stays as it is."""
    explained = 0.0
    """Share of the variance of the last rollout's returns that the critic explained, over rows that acted."""

    def train(self) -> None:
        """Learn from the rollout, and log SB3's figures."""
        self.policy.critic_alone, buffer = self.critic_alone, self.rollout_buffer
        super().train()
        acted = buffer.swap_and_flatten(buffer.acted).flatten()
        self.explained = float(explained_variance(buffer.values.flatten()[acted], buffer.returns.flatten()[acted]))
