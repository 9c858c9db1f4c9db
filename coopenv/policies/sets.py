"""A learned driver for any environment: a network over sets of landmarks and cars steers, a rule gives way.

Every landmark and every car goes through a network of its kind, and sums and maxima over each kind go on; so there may
be any number of each. Source: Zaheer et al., Deep Sets, Advances in Neural Information Processing Systems 30, 2017.
Inputs are in metres and radians whatever the scales of the observation, and the camera, the noise and the top speed
are among them.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from coopenv.base.errors import AgentWarning, CoopenvError
from coopenv.policies.loader import NetworkCard
from coopenv.policies.look_ahead import LookAhead
from coopenv.policies.network import load_weights
from coopenv.scenario import Scenario

ENTRY = f"{__name__}:SavedSetDriver"
"""The `entry` of learned agents of this kind."""
METRES = 4.0
"""Unit of distances, m, for inputs of order one."""
FARTHEST_REACH = 20.0
"""m; the range of a camera without one."""
SETS = ("landmark", "car")
LAYERS, HEAD_LAYERS = 2, 3
CONSTANTS = ("max_speed", "view_left", "view_right", "range", "sees_landmarks", "drift", "turn_drift", "bearing_std")
"""Properties of vehicle and environment, constant in an episode; the last inputs of a network beside the sets."""
SLACK = 0.25
"""Share of a constant by which it may be beyond the training."""

Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]
"""The vehicle itself (rows, E); landmarks (rows, K, 7) and cars (rows, M, 12), beginning with 1 where there is one."""


class SetDriver(LookAhead):
    """Drives at the speed of `LookAhead`, which gives way; the network steers in place of its plans.

    Where something stands in the way, or so far off the route that plans lead back to it, it drives by a plan.
    """

    needs = (*LookAhead.needs, "map_in_view", "last_action")
    remembers = 0

    def __init__(self, scenario: Scenario, weights: Mapping[str, np.ndarray]) -> None:
        """Build it for a scenario; without weights it gives inputs only.

        Raises:
            ValueError: as for `Driver`, or a vehicle does not steer.
        """
        super().__init__(scenario)
        if self._by_rate.any():
            raise ValueError("its network chooses steering angles: dynamics.model must be 'bicycle'")
        self._weights = weights
        count = len(self._top)
        columns: list[np.ndarray | list[float]] = [
            self._top,
            [view.left for view in self._views],
            [view.right for view in self._views],
            [min(view.reach, FARTHEST_REACH) for view in self._views],
            self._sees_landmarks,
            *(np.full(count, value) for value in np.sqrt([self.drift, self.turn_drift, self.bearing])),
        ]
        self.constants = np.stack(columns, axis=1).astype(np.float32)
        """(N, 8), by the names of `CONSTANTS`: m/s, rad, rad, m, 0 or 1, m and rad per root of a second, rad."""
        sizes = np.array([vehicle.body.size[:2] if vehicle.body else (0.0, 0.0) for vehicle in scenario.vehicles])
        self._cars = np.column_stack([self._top, sizes])  # m/s, m

    def drive(self, observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """See `Driver.drive`."""
        plans, speed, around = self.rule(observations)
        vehicle = np.arange(len(observations)) % len(self._top)
        return speed, np.where(plans, around, self.steer(self.inputs(observations, vehicle)))

    def inputs(self, observations: np.ndarray, vehicle: np.ndarray) -> Inputs:
        """Return what the network sees in rows that are of these vehicles, (rows,)."""
        names = ("axis_std", "heading_std", "route_offset", "route_heading", "route_ahead")
        own = [self.read(observations, name) for name in names]
        alone = np.concatenate([*own, self.read(observations, "last_action")[:, 1:2], self.constants[vehicle]], axis=1)
        place, seen = self.read(observations, "map_position")[..., :2], self.read(observations, "map_in_view")
        landmarks = _rows(self.known(observations), place, seen[..., None])
        received, place, forward = self.reported(observations)
        sender = np.arange(received.shape[1]) + (np.arange(received.shape[1]) >= vehicle[:, None])
        cars = forward, self._cars[sender % len(self._cars)], self.avoided(received, vehicle)[..., None]
        return alone.astype(np.float32), landmarks, _rows(received, place, *cars)

    def steer(self, inputs: Inputs) -> np.ndarray:
        """Return the steering angles, (rows,) in rad."""
        alone = (inputs[0] - self._weights["mean"]) / self._weights["std"]
        parts = [alone]
        for name, rows in zip(SETS, inputs[1:], strict=True):
            weight, columns = self._weights[f"{name}.0.weight"].T, rows.shape[-1]
            # The vehicle's own entries are the same for all rows of a set: they are multiplied once.
            hidden = rows @ weight[:columns] + (alone @ weight[columns:] + self._weights[f"{name}.0.bias"])[:, None]
            hidden = self._layers(np.maximum(hidden, 0.0), name, 1, LAYERS) * rows[..., :1]
            parts += [hidden.sum(axis=1) / METRES, hidden.max(axis=1)]
        return np.asarray(self._layers(np.concatenate(parts, axis=1), "head", 0, HEAD_LAYERS, linear=True)[:, 0])

    def _layers(self, values: np.ndarray, name: str, first: int, end: int, linear: bool = False) -> np.ndarray:
        for i in range(first, end):
            values = values @ self._weights[f"{name}.{i}.weight"].T + self._weights[f"{name}.{i}.bias"]
            if not linear or i < end - 1:
                values = np.maximum(values, 0.0)
        return values


class SavedSetDriver(SetDriver):
    """One that `coopenv train` has written to an agent's folder."""

    def __init__(self, scenario: Scenario, *, folder: Path, network: NetworkCard) -> None:
        """Load the weights; warn where the environment's constants are beyond those of the training.

        Raises:
            CoopenvError: the weights cannot be read, or are not of this kind.
        """
        path = folder / network.weights
        super().__init__(scenario, load_weights(path, network.sha256))
        try:
            none = [np.zeros((1, width), dtype=np.float32) for width in (self._weights["mean"].size, 7, 12)]
            self.steer((none[0], none[1][None], none[2][None]))
        except (KeyError, ValueError) as error:
            raise CoopenvError(f"{path}: not the weights of a network over sets: {error}") from None
        for place, name in enumerate(CONSTANTS):
            low, high = network.seen.get(name, (-np.inf, np.inf))
            values, slack = self.constants[:, place], SLACK * max(abs(low), abs(high))
            if np.any((values < low - slack) | (values > high + slack)):
                here = f"'{name}' is {values.min():.3g} to {values.max():.3g} here"
                text = f"agent {folder.resolve().name}: {here}, and was {low:.3g} to {high:.3g} in its training"
                warnings.warn(AgentWarning(text), stacklevel=2)
                break


def _rows(there: np.ndarray, place: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return a set's rows, (rows, K, columns): what is not there is 0; places, m, have distance and direction, too."""
    distance = np.linalg.norm(place, axis=-1, keepdims=True)
    known = [place / METRES, distance / METRES, place / np.maximum(distance, 0.1), *columns]
    rows = np.concatenate([np.ones_like(distance), *known], axis=-1) * there[..., None]
    return np.asarray(rows, dtype=np.float32)
