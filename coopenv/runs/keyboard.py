"""Drive a vehicle by the arrow keys."""

from typing import Any

import numpy as np

from coopenv.api.terms.layout import action_fields
from coopenv.policies import Policy, restart
from coopenv.scenario import Scenario

LEAVE, AGAIN = {"escape", "q"}, {"r"}
HELP = "Arrow keys: faster, slower, left, right. r: again. Escape: leave."
FULL_SPEED, FULL_STEERING = 1.0, 0.4
"""s that a key is held for the whole range: from standstill to top speed, from straight ahead to full steering."""


class Keys:
    """Which keys are held down, as the canvas of a window tells."""

    def __init__(self, canvas: Any) -> None:
        """Listen to a canvas of matplotlib."""
        self.held: set[str] = set()
        self.struck: set[str] = set()
        """Keys that were pressed since somebody cleared this."""
        canvas.mpl_connect("key_press_event", self._press)
        canvas.mpl_connect("key_release_event", self._release)

    def _press(self, event: Any) -> None:
        if event.key is not None:
            self.held.add(event.key)
            self.struck.add(event.key)

    def _release(self, event: Any) -> None:
        self.held.discard(event.key)

    def direction(self, plus: str, minus: str) -> float:
        """Return 1, -1 or 0 by which of two keys is held."""
        return float(plus in self.held) - float(minus in self.held)


class Keyboard:
    """A policy of one world that drives a vehicle by keys and leaves the others to another policy."""

    def __init__(self, scenario: Scenario, vehicle: int, others: Policy, keys: Keys) -> None:
        """Choose who is driven by whom; `vehicle` is an index."""
        self.keys, self._vehicle, self._others = keys, vehicle, others
        self._longitudinal = action_fields(scenario, scenario.limits[vehicle])[0]
        self._period = 1.0 / scenario.rates.decision
        self.reset(np.ones(len(scenario.vehicles), dtype=bool))

    def reset(self, mask: np.ndarray) -> None:
        """Begin anew, standing, with straight wheels."""
        low, high = self._longitudinal.low, self._longitudinal.high
        self._level = -(high + low) / (high - low)  # of nothing: no speed, no acceleration
        self._still, self._steering = self._level, 0.0
        restart(self._others, mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions, (vehicles, A)."""
        actions = np.array(self._others(observations), dtype=float)
        pedal, wheel = self.keys.direction("up", "down"), self.keys.direction("left", "right")
        if self._longitudinal.name == "speed":
            self._level = float(
                np.clip(self._level + pedal * (1.0 - self._still) * self._period / FULL_SPEED, -1.0, 1.0)
            )
            if pedal < 0.0 and self._longitudinal.low == 0.0:
                self._level = max(self._level, self._still)
        else:
            self._level = pedal
        step = self._period / FULL_STEERING
        self._steering = float(np.clip(wheel, self._steering - step, self._steering + step))
        actions[self._vehicle] = 0.0
        actions[self._vehicle, :2] = self._level, self._steering
        return actions
