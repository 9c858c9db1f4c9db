"""The observer `robust` with a look at its belief."""

from __future__ import annotations

import numpy as np

from coopenv.observers import Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.memory import SOURCES
from coopenv.observers.robust.observer import ROBUST


class OpenRobust(KernelObserver):
    """One vehicle's observer whose belief can be read."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(ROBUST, setup)

    @property
    def members(self) -> np.ndarray:
        """Records of the members: the vehicle itself, its calibration states, other vehicles."""
        return self.memory.member[: self.memory.belief["members"]]

    @property
    def others(self) -> np.ndarray:
        """Records of the members that are other vehicles."""
        return self.members[self.memory.belief["first_sender"] :]

    @property
    def member_numbers(self) -> list[int]:
        """Which vehicles are members, the vehicle itself first."""
        return [self.setup.vehicle, *self.others["vehicle"].tolist()]

    @property
    def P(self) -> np.ndarray:
        """(6n, 6n) joint covariance of n members."""
        n = len(self.members)
        return self.memory.P[:n, :n].swapaxes(1, 2).reshape(6 * n, 6 * n)

    def slot(self, target: int) -> int:
        """Return the slot of the monitor of a target, -1 if it has none."""
        return next((q for q in range(1, SOURCES) if self.memory.source["target"][q] == target), -1)

    @property
    def excluded(self) -> set[int]:
        """Which targets are excluded."""
        source = self.memory.source
        return set(source["target"][source["excluded"] == 1].tolist())
