"""Compile kernels once per precision, and replay their launches.

Each kernel gets a Warp module of its own and of its precision, so that it is compiled once and then found in the cache
whatever else a program uses; a generic kernel in a shared module would be rebuilt for every new combination.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from typing import Any

import warp as wp

wp.config.log_level = wp.LOG_ERROR


@cache
def kernel(function: Callable[..., None], precision_name: str) -> wp.Kernel:
    """Return a plain Python function as a Warp kernel whose module serves one precision only."""
    module = wp.get_module(f"{function.__module__}.{function.__name__}.{precision_name}")
    module.options["enable_backward"] = False
    return wp.Kernel(func=function, key=function.__name__, module=module)


class Launcher:
    """Launches kernels of one grid on one device; the first launch is recorded, later ones take a microsecond.

    A recorded launch keeps its arguments, so a key must always come with the same ones.
    """

    def __init__(self, dim: int | tuple[int, ...], device: str, precision_name: str) -> None:
        self._dim, self._device, self._precision = dim, device, precision_name
        self._recorded: dict[Hashable, Any] = {}

    def __call__(self, key: Hashable, function: Callable[..., None], arguments: list[Any]) -> None:
        """Run a kernel over the grid."""
        command = self._recorded.get(key)
        if command is None:
            command = wp.launch(
                kernel(function, self._precision),
                dim=self._dim,
                inputs=arguments,
                device=self._device,
                record_cmd=True,
            )
            self._recorded[key] = command
        command.launch()
