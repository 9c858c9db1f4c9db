"""`robust` in NumPy that says what the kernels say, to be compared with them tick by tick.

Messages are in single precision and in whole steps. Where two computations of a number stand on either side of where it
is rounded, what they say differs by a step that is far larger than they differ by. So both hear the same, and what they
would say is compared as exactly as it is said.
"""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from coopenv.estimation.arrays import Array
from coopenv.observers import Estimate, Tick
from coopenv.observers.contract import Message, Setup
from coopenv.observers.kernel_observer import KernelObserver
from coopenv.observers.registry import find_embedded
from tests.oracles.robust.observer import Robust


class Spoken(Robust):
    """One vehicle's observer in NumPy, with that of the kernels beside it, whose messages it sends."""

    def __init__(self, setup: Setup) -> None:
        """Take what the vehicle knows before it starts."""
        super().__init__(setup)
        embedded = find_embedded("robust")
        assert embedded is not None
        self.spoken = KernelObserver(embedded, setup)

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start both at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.spoken.reset(initial_pose, initial_covariance)

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick, and let the kernels take it."""
        self.spoken.update(tick)
        return super().update(tick)

    def message(self) -> Message:
        """Return what the kernels say, which is what this one says."""
        said, own = self.spoken.message(), super().message()
        assert (said.position is None) == (own.position is None)
        if said.position is not None:
            assert said.extra.keys() == own.extra.keys()
            for name in ("position", "rotation", "covariance"):
                compare(name, np.asarray(getattr(said, name), float), np.asarray(getattr(own, name), float))
            for name, value in said.extra.items():
                compare(name, np.asarray(value), np.asarray(own.extra[name]))
        return said


def compare(name: str, said: Array, own: Array) -> None:
    """Assert that a part of a message is the same but for how it is rounded."""
    if name == "correlations":
        assert abs(said.astype(int) - own).max(initial=0) <= 1, name
    elif said.dtype.kind == "f":
        assert_allclose(said, own, rtol=1e-6, atol=1e-6 * abs(own).max(initial=1e-3), err_msg=name)
    else:
        assert_array_equal(said, own, err_msg=name)
