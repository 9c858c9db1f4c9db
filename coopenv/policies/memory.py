"""The memory of a learned policy: a gated recurrent unit over what a vehicle has observed in its episode."""

from collections.abc import Mapping

import numpy as np

MEMORY = "memory."
"""Beginning of the names of its tensors."""
PARTS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")


class Memory:
    """Keeps a state of M numbers for every row, which the policy reads beside the observation.

    Source: Cho et al., Learning phrase representations using RNN encoder-decoder, 2014, in the form of torch's
    `GRUCell`.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Take the parameters by the names of an agent's weights, and forget everything."""
        self._read, self._keep, *self._bias = (tensors[f"{MEMORY}{part}"] for part in PARTS)
        self.state = np.zeros((0, self._keep.shape[1]), dtype=np.float32)
        """State of every row, (rows, M)."""

    def reset(self, mask: np.ndarray) -> None:
        """Forget what the rows of a mask (rows,), bool, remember."""
        if len(mask) != len(self.state):
            self.state = np.zeros((len(mask), self.state.shape[1]), dtype=np.float32)
        self.state = np.where(mask[:, None], np.float32(0.0), self.state)

    def __call__(self, seen: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Remember normalised observations (rows, D), and return them with the new state beside, (rows, D + M).

        With flags of `rows`, (rows,), the others remember nothing of it.
        """
        if len(seen) != len(self.state):
            self.reset(np.ones(len(seen), dtype=bool))
        read, kept = (
            np.split(values @ weight.T + bias, 3, axis=1)
            for values, weight, bias in zip((seen, self.state), (self._read, self._keep), self._bias, strict=True)
        )
        opened, stays = (1.0 / (1.0 + np.exp(-(read[gate] + kept[gate]))) for gate in (0, 1))
        fresh = np.tanh(read[2] + opened * kept[2])
        new = (fresh + stays * (self.state - fresh)).astype(np.float32)
        self.state = new if rows is None else np.where(rows[:, None], new, self.state)
        return np.concatenate([seen, self.state], axis=1)
