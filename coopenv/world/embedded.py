"""Which kernels advance and reset the worlds of an embedded observer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from coopenv.world.step import advance_kernel, reset_kernel

ROBUST = "robust"
"""Value of `observer.name` whose observer remembers more than the state holds."""


class Kernels(NamedTuple):
    """Arguments: model, state, the observer's memory if it has one, then those of `advance_kernel`, `reset_kernel`."""

    advance: Callable[..., None]
    reset: Callable[..., None]


def kernels_of(memory: Any) -> Kernels:
    """Return the kernels of worlds whose observer has a memory, or (None) has not."""
    if memory is None:
        return Kernels(advance_kernel, reset_kernel)
    from coopenv.observers.robust.kernels import advance_robust_kernel, reset_robust_kernel

    return Kernels(advance_robust_kernel, reset_robust_kernel)
