"""PPO by TorchRL on a batch of worlds, which learns from rows of vehicles under way. Needs the extra `torchrl`.

Usage: python examples/trainers/torchrl_ppo.py
"""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl_env import batched_env

import coopenv

ROWS = "vehicle"
ENVIRONMENT = "urban_crossing"
EPOCHS = 8


def train(
    updates: int = 300, steps: int = 200, worlds: int = 4, seed: int = 1
) -> tuple[list[float], list[torch.Tensor], list[torch.Tensor]]:
    """Train a policy of all vehicles; return the critic's losses, and the policy's parameters before and after."""
    torch.manual_seed(seed)
    env = batched_env(ENVIRONMENT, num_worlds=worlds, seed=seed)
    size = env.observation_spec[ROWS, "observation"].shape[-1]
    network = torch.nn.Sequential(MLP(size, 4, num_cells=[64, 64]), NormalParamExtractor())
    policy = ProbabilisticActor(
        TensorDictModule(network, [(ROWS, "observation")], [(ROWS, "loc"), (ROWS, "scale")]),
        spec=env.full_action_spec,
        in_keys=[(ROWS, "loc"), (ROWS, "scale")],
        out_keys=[(ROWS, "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=(ROWS, "sample_log_prob"),
    )
    critic = TensorDictModule(MLP(size, 1, num_cells=[64, 64]), [(ROWS, "observation")], [(ROWS, "state_value")])
    discount = 1.0 - 1.0 / coopenv.load_scenario(ENVIRONMENT).decisions
    advantage = GAE(gamma=discount, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(policy, critic, normalize_advantage=True)
    keys = {name: (ROWS, name) for name in ("advantage", "value_target", "reward", "done", "terminated")}
    advantage.set_keys(value=(ROWS, "state_value"), **keys)
    loss.set_keys(
        value=(ROWS, "state_value"), action=(ROWS, "action"), sample_log_prob=(ROWS, "sample_log_prob"), **keys
    )
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    before, losses = [parameter.detach().clone() for parameter in policy.parameters()], []
    for _ in range(updates):
        with torch.no_grad():
            rollout = advantage(env.rollout(steps, policy, break_when_any_done=False))
        vehicles = rollout[ROWS].exclude("info")
        living = TensorDict({ROWS: vehicles[vehicles["mask"]]}, batch_size=[int(vehicles["mask"].sum())])
        for _ in range(EPOCHS):
            parts = loss(living)
            optimiser.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]).backward()
            optimiser.step()
            losses.append(parts["loss_critic"].item())
    return losses, before, [parameter.detach() for parameter in policy.parameters()]


if __name__ == "__main__":
    found, *_ = train()
    print(f"loss of the critic: {found[0]:.3f} at first, {found[-1]:.3f} at the end")
