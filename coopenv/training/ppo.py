"""PPO of Stable-Baselines3 with the gradient of its loss in closed form. Needs the extra `train`.

Loss, minibatches, optimiser and random numbers are those of SB3's `PPO`, and so are the results, except for rounding.
The update takes less CPU time: no graph is recorded, tanh is NumPy's, and on AMD matrices are multiplied by oneDNN.
"""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import RolloutBufferSamples, Schedule
from stable_baselines3.common.utils import explained_variance
from torch import Tensor, nn

ONEDNN: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None)  # private to torch
CPUINFO = Path("/proc/cpuinfo")
LOG_DENSITY = 0.5 * math.log(2.0 * math.pi)  # of a standard normal number at 0, negated


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


def outputs(layers: Sequence[nn.Linear], rows: Tensor) -> list[Tensor]:
    """Return the inputs (rows, D) of every layer of a tanh network and, last, its output (rows, A)."""
    found = [rows]
    for layer in layers:
        rows = product(rows, layer.weight, layer.bias)
        if layer is not layers[-1]:
            np.tanh(rows.numpy(), out=rows.numpy())  # torch's takes ten times as long
        found.append(rows)
    return found


def differentiate(layers: Sequence[nn.Linear], found: Sequence[Tensor], slope: Tensor) -> None:
    """Write a loss's derivatives with respect to the parameters of a tanh network into their `grad`.

    Args:
        layers: of the network.
        found: what `outputs` returned.
        slope: derivative of the loss with respect to the network's output, (rows, A).
    """
    for layer, inputs in zip(reversed(layers), reversed(found[:-1]), strict=True):
        layer.weight.grad, layer.bias.grad = product(slope.t(), inputs.t()), slope.sum(0)
        if layer is not layers[0]:
            slope = torch.ops.aten.tanh_backward(product(slope, layer.weight.t()), inputs)


class TanhPolicy(ActorCriticPolicy):
    """SB3's `MlpPolicy` on the CPU for actions in a box: a tanh network for their mean, and one for the value."""

    def layers(self) -> tuple[list[nn.Linear], list[nn.Linear]]:
        """Return the layers of the networks for the mean and for the value."""
        networks: tuple[tuple[Any, Any], ...] = (
            (self.mlp_extractor.policy_net, self.action_net),
            (self.mlp_extractor.value_net, self.value_net),
        )
        actor, critic = ([*(part for part in net if isinstance(part, nn.Linear)), end] for net, end in networks)
        return actor, critic

    @torch.no_grad()
    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (rows, A), values (rows, 1) and logarithms of the actions' densities (rows,)."""
        mean = outputs(self.layers()[0], obs)[-1]
        distribution = self.action_dist.proba_distribution(mean, self.log_std)
        actions = distribution.get_actions(deterministic)
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    @torch.no_grad()
    def predict_values(self, obs: Any) -> Tensor:
        """Return values, (rows, 1)."""
        return outputs(self.layers()[1], obs)[-1]


class LeanPpo(PPO):
    """SB3's `PPO` for a `TanhPolicy`, without `clip_range_vf`, `target_kl` and `use_sde`."""

    policy: TanhPolicy
    clip_range: Schedule

    @torch.no_grad()
    def train(self) -> None:
        """Learn from the rollout, and log what SB3 logs."""
        self._update_learning_rate(self.policy.optimizer)
        clip, buffer = self.clip_range(self._current_progress_remaining), self.rollout_buffer
        passes = [[self._improve(rows, clip) for rows in buffer.get(self.batch_size)] for _ in range(self.n_epochs)]
        self._n_updates += self.n_epochs
        steps = [step for steps in passes for step in steps]
        figures = {name: float(np.mean([step[name] for step in steps])) for name in steps[0]}
        figures["approx_kl"] = float(np.mean([step["approx_kl"] for step in passes[-1]]))
        figures["loss"] = steps[-1]["loss"]
        figures["explained_variance"] = float(explained_variance(buffer.values.flatten(), buffer.returns.flatten()))
        figures["std"] = float(self.policy.log_std.exp().mean())
        for name, value in {**figures, "clip_range": clip}.items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _improve(self, rows: RolloutBufferSamples, clip: float) -> dict[str, float]:
        """Take one gradient step on a minibatch; return the figures that SB3 logs of it."""
        policy, (actor, critic), count = self.policy, self.policy.layers(), len(rows.advantages)
        advantages, precision = rows.advantages, torch.exp(-policy.log_std)
        if count > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        found = outputs(actor, rows.observations)
        deviation = (rows.actions - found[-1]) * precision
        change = -(0.5 * deviation**2 + policy.log_std + LOG_DENSITY).sum(1) - rows.old_log_prob
        ratio = change.exp()
        gain = torch.minimum(advantages * ratio, advantages * ratio.clamp(1.0 - clip, 1.0 + clip))
        # Where the clipped ratio, a constant, gives the smaller gain, the loss does not depend on the density.
        free = torch.where(advantages > 0.0, ratio <= 1.0 + clip, ratio >= 1.0 - clip)
        slope = (free * advantages * ratio).div_(-count).unsqueeze(1)  # with respect to the logarithm of the density
        differentiate(actor, found, slope * deviation * precision)
        policy.log_std.grad = (slope * (deviation**2 - 1.0)).sum(0).sub_(self.ent_coef)
        found = outputs(critic, rows.observations)
        excess = found[-1].squeeze(1) - rows.returns
        differentiate(critic, found, excess.mul(2.0 * self.vf_coef / count).unsqueeze(1))
        figures = {
            "policy_gradient_loss": -float(gain.mean()),
            "value_loss": float(excess.square().mean()),
            "entropy_loss": -float((policy.log_std + LOG_DENSITY + 0.5).sum()),
            "clip_fraction": float(((ratio - 1.0).abs() > clip).float().mean()),
            "approx_kl": float((ratio - 1.0 - change).mean()),
        }
        nn.utils.clip_grad_norm_(policy.parameters(), self.max_grad_norm, foreach=True)
        policy.optimizer.step()
        weighted = self.ent_coef * figures["entropy_loss"] + self.vf_coef * figures["value_loss"]
        return {**figures, "loss": figures["policy_gradient_loss"] + weighted}
