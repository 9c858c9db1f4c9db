"""Read a dictionary of actions into one array, or say in one line what is wrong with it."""

from collections.abc import Mapping, Sequence

import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.errors import ActionError, suggest


class ActionReader:
    """Turns {agent: (A,)} into (1, N, A), clipped to [-1, 1]."""

    def __init__(self, index: Mapping[str, int], engine: Engine) -> None:
        self._index = index  # of possible agents among the vehicles
        self._engine = engine
        self._size = engine.view("actions").shape[-1]

    def __call__(self, actions: Mapping[str, np.ndarray], alive: Sequence[str]) -> np.ndarray:
        """Return the actions of the living agents; those that have ended keep their last one, whatever is given.

        Raises:
            ActionError: an action is missing, unknown, of the wrong shape, or not finite.
        """
        if not isinstance(actions, Mapping):
            raise ActionError(f"actions must be a dict of agent to array, got {type(actions).__name__}")
        try:
            values = np.array([actions[agent] for agent in alive])
        except (IndexError, KeyError, TypeError, ValueError, RuntimeError):
            values = np.empty(0)
        numeric = values.dtype.kind in "fiu" and values.shape == (len(alive), self._size)
        unknown = len(actions) != len(alive) and not set(actions) <= set(self._index)
        if not numeric or unknown or not np.isfinite(values).all():
            self._complain(actions, alive)
        whole = self._engine.view("actions").copy()
        whole[0, [self._index[agent] for agent in alive]] = np.clip(values, -1.0, 1.0)
        return whole

    def _complain(self, actions: Mapping[str, np.ndarray], alive: Sequence[str]) -> None:
        for agent in actions:
            if agent not in self._index:
                raise ActionError(
                    f"action for unknown agent '{agent}'{suggest(str(agent), self._index)}; agents: {', '.join(alive)}"
                )
        for agent in alive:
            if agent not in actions:
                raise ActionError(f"no action for '{agent}'; agents: {', '.join(alive)}")
            check_action(actions[agent], agent, self._size)


def check_action(action: object, agent: str, size: int) -> np.ndarray:
    """Return one action as a float array.

    Raises:
        ActionError: wrong shape, not a number, or not finite.
    """
    try:
        value = np.asarray(action)
    except (TypeError, ValueError):
        value = np.array("?")
    if value.dtype.kind not in "fiu":
        raise ActionError(f"action of '{agent}' is not numeric: {action!r}")
    if value.shape != (size,):
        raise ActionError(f"action of '{agent}' has shape {value.shape}, expected ({size},)")
    if not np.isfinite(value).all():
        raise ActionError(f"action of '{agent}' is not finite: {value.tolist()}")
    return value
