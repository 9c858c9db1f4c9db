"""The observer `robust` with a look at its belief."""

from __future__ import annotations

import numpy as np

from coopenv.observers import Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.observer import ROBUST


class OpenRobust(KernelObserver):
    """One vehicle's observer whose belief can be read."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(ROBUST, setup)

    @property
    def members(self) -> np.ndarray:
        """Records of the members, the vehicle itself first."""
        return self.memory.member[: self.memory.belief["members"]]

    @property
    def member_numbers(self) -> list[int]:
        """Which vehicles are members."""
        return self.members["vehicle"].tolist()

    @property
    def P(self) -> np.ndarray:
        """(6n, 6n) joint covariance of n members."""
        n = len(self.members)
        return self.memory.P[:n, :n].swapaxes(1, 2).reshape(6 * n, 6 * n)

    @property
    def trusted(self) -> dict[int, bool]:
        """Whether the other members are trusted."""
        return {int(m["vehicle"]): not m["excluded"] for m in self.members[1:]}
