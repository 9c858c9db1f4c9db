"""The observers `robust` and `robust_joint` with a look at what they believe."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopenv.observers import Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.robust.constants import MAX_MEMBERS, MAX_MEMBERS_JOINT
from coopenv.observers.robust.joint_fusion import ROBUST_JOINT
from coopenv.observers.robust.observer import ROBUST


class Open(KernelObserver):
    """One vehicle's observer whose belief can be read."""

    kernels: Any
    most_members: int

    def __init__(self, setup: Setup) -> None:
        super().__init__(self.kernels, setup)

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

    @property
    def told(self) -> dict[int, set[int]]:
        """Of whom the last message of every sender tells that tells of members alone, by sender."""
        return {vehicle: {vehicle} for vehicle in self.member_numbers[1:]}


class OpenRobust(Open):
    """`robust`."""

    kernels, most_members = ROBUST, MAX_MEMBERS


class OpenJoint(Open):
    """`robust_joint`."""

    kernels, most_members = ROBUST_JOINT, MAX_MEMBERS_JOINT

    @property
    def told(self) -> dict[int, set[int]]:
        """As for `Open`."""
        contacts = zip(self.memory.contact, self.memory.contact_broadcast["vehicle"], strict=True)
        return {int(c["sender"]): set(told[: c["count"]].tolist()) for c, told in contacts if c["sender"] >= 0}
