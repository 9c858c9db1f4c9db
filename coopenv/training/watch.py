"""What is shown while a policy learns: how vehicles did in the last rollout. Needs the extra `train`."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from coopenv.api.trainers.sb3 import CooperativeSB3VecEnv
from coopenv.evaluation.metrics import SETTLED_FROM

EPISODES = 200
"""Last episodes of vehicles over which is averaged."""


@dataclass(frozen=True)
class Status:
    """How far a training is, and how the exploring policy did lately."""

    steps: int
    """Decisions of vehicles so far."""
    seconds: float
    share: float
    """Of the budget, 0 to 1."""
    figures: dict[str, float]
    """`return`, `arrival_rate` and `collision_rate` over the last episodes; `e50_m` and `e95_m` in the last rollout."""

    @property
    def line(self) -> str:
        """The status in a few words."""
        f = self.figures
        parts = [f"{self.steps / 1e6:.2f} M steps", f"{self.steps / max(self.seconds, 1e-9):,.0f}/s"]
        if "return" in f:
            parts += [f"return {f['return']:.1f}", f"arrived {f['arrival_rate']:.0%}", f"hit {f['collision_rate']:.0%}"]
        if "e95_m" in f:
            parts.append(f"e95 {100 * f['e95_m']:.0f} cm")
        return ", ".join(parts)


class Watch(BaseCallback):
    """Collects errors of the rollout and ends of episodes, and records both for TensorBoard."""

    def __init__(self, env: CooperativeSB3VecEnv) -> None:
        super().__init__()
        self._env = env
        self._errors: list[np.ndarray] = []
        self._ended: deque[dict[str, Any]] = deque(maxlen=EPISODES)

    def _on_step(self) -> bool:
        told = self._env.batch_infos
        counts = self._env.acted & (told["time"] > SETTLED_FROM)
        self._errors.append(told["position_error"][counts])
        self._ended.extend(self.locals["infos"][row] for row in np.flatnonzero(self.locals["dones"]))
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.figures().items():
            self.logger.record(f"vehicles/{name}", value)
        for name in self._env.engine.reward_terms if self._ended else ():
            mean = np.mean([info["reward_terms"][name] for info in self._ended])
            self.logger.record(f"reward_terms/{name}", float(mean))

    def figures(self) -> dict[str, float]:
        """Return what `Status` holds."""
        found: dict[str, float] = {}
        errors = np.concatenate(self._errors) if self._errors else np.empty(0)
        if errors.size:
            found |= {"e50_m": float(np.median(errors)), "e95_m": float(np.percentile(errors, 95))}
        if self._ended:
            outcomes = [info["outcome"] for info in self._ended]
            found["return"] = float(np.mean([info["episode"]["r"] for info in self._ended]))
            found["arrival_rate"] = outcomes.count("arrived") / len(outcomes)
            found["collision_rate"] = outcomes.count("collided") / len(outcomes)
        return found

    def _on_rollout_start(self) -> None:
        self._errors.clear()
