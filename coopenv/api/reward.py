"""A reward in Python: a function of the results of a step, of all vehicles of all worlds at once."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, error_text, shown, suggest
from coopenv.estimation.outcomes import Sight
from coopenv.scenario import Scenario

FIELDS = (
    "observation",
    "action",
    "reward",
    "alive",
    "terminated",
    "truncated",
    "ended",
    "position_error",
    "orientation_error",
    "nees",
    "log_determinant",
    "position_std",
    "gramian_min_eigenvalue",
    "targets_in_view",
)
"""Fields of an engine under the same name."""
OTHERS = ("truth", "estimate", "reward_terms", "visible", "time")


class Step:
    """Results of a step: the infos of N vehicles in W worlds as arrays, read-only until the next step.

    - `position_error` (m), `orientation_error` (deg), `nees`, `log_determinant`, `position_std` (m),
      `gramian_min_eigenvalue`, `targets_in_view`: (W, N);
    - `truth`: position (m, map frame), velocity and angular_velocity (m/s, rad/s, body frame), each (W, N, 3), and
      rotation (W, N, 3, 3), body to map; `estimate`: position, rotation, and covariance (W, N, 6, 6);
    - `visible`: (W, N, T), the targets measured in this frame; `time`: (W, 1), s since the reset;
    - `observation`: (W, N, D), scaled and clipped; `action`: (W, N, A) in [-1, 1];
    - `reward_terms`: (W, N) by name, and `reward`, what the scenario's weights make of them;
    - `alive`, `terminated`, `truncated`: (W, N) bool; `ended`: (W, N), 0 under way, 1 arrived, 2 collided, 3 off
      route, from 4 on the scenario's own conditions.
    """

    def __init__(self, view: Callable[[str], np.ndarray], scenario: Scenario) -> None:
        """Read the fields that `view` gives by name, see `Engine.view`."""
        self._view, self._landmarks = view, len(scenario.landmarks)
        self._terms, self._tick_length = tuple(scenario.reward.by_name), 1.0 / scenario.rates.camera

    def __getitem__(self, name: str) -> Any:
        """Return an array, or a dictionary of arrays.

        Raises:
            CoopenvError: no such name.
        """
        if name in FIELDS:
            return _locked(self._view(name))
        if name == "truth":
            moved = ("position", "rotation", "velocity", "angular_velocity")
            return {key: _locked(self._view(key)[:, self._landmarks :]) for key in moved}
        if name == "estimate":
            rotation, in_body = self._view("estimate_rotation"), self._view("estimate_position")
            position = np.matmul(rotation, in_body[..., None])[..., 0]
            return {
                "position": position,
                "rotation": _locked(rotation),
                "covariance": _locked(self._view("covariance")),
            }
        if name == "reward_terms":
            return dict(zip(self._terms, np.moveaxis(_locked(self._view("terms")), -1, 0), strict=True))
        if name == "visible":
            return self._view("sight") == Sight.VISIBLE
        if name == "time":
            return self._view("tick")[:, None] * self._tick_length
        raise CoopenvError(f"a step has no '{name}'{suggest(str(name), self)}; known: {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        return iter((*FIELDS, *OTHERS))


RewardFunction = Callable[[Step], Any]
"""Returns the reward of every vehicle, (W, N), for one decision step."""


def check_function(reward: object, device: str) -> None:
    """Make sure that a reward is a function, if there is one, and that its arrays are at hand.

    Raises:
        CoopenvError: it is not so.
    """
    if reward is not None and not callable(reward):
        raise CoopenvError(f"reward: expected a function of a step, got {shown(reward)}")
    if reward is not None and device != "cpu":
        raise CoopenvError(f"reward: a function in Python runs on the host; use device='cpu' instead of '{device}'")


def reward_of(function: RewardFunction, step: Step, earning: np.ndarray) -> np.ndarray:
    """Return the rewards (W, N) of a user's function for rows of a mask (W, N), bool; 0 elsewhere.

    Raises:
        CoopenvError: the function raises something, or returns another shape or what is no number.
    """
    title = f"reward function {getattr(function, '__name__', shown(function))}"
    try:
        values = np.asarray(function(step))
    except Exception as error:  # anybody's code
        raise CoopenvError(f"{title}: {error_text(error)}") from error
    if values.shape != earning.shape or values.dtype.kind not in "biuf":
        worlds, vehicles = earning.shape
        given = f"shape {values.shape} and dtype {values.dtype}"
        raise CoopenvError(
            f"{title}: returned {given}, expected numbers of shape ({worlds}, {vehicles}), worlds x vehicles"
        )
    result = np.where(earning, values, 0.0)
    check_finite(title, result)
    return result


def check_finite(title: str, values: np.ndarray) -> None:
    """Check that the values (W, N, ...) of a user's term are finite.

    Raises:
        CoopenvError: it is not.
    """
    if not np.isfinite(values).all():
        world, vehicle, *_ = place = np.argwhere(~np.isfinite(values))[0]
        raise CoopenvError(
            f"{title}: {values[tuple(place)]} for vehicle_{vehicle + 1} of world {world}, expected a number"
        )


def _locked(values: np.ndarray) -> np.ndarray:
    """Return a read-only view."""
    view = values.view()
    view.flags.writeable = False
    return view
