"""Replay of recorded launches through Warp's private interface.

`context._build_cpu_args_structs` packs the arguments of a launch, `command.hooks.forward` is the compiled kernel. Both
are private, so that `pyproject.toml` bounds the version of Warp; without them `command.launch` does the same, slower.
"""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

from warp._src import context


def replay_of(command: Any) -> Callable[[], Any]:
    """Return a function that runs a recorded launch again.

    On the CPU Warp packs the arguments, some kilobytes, anew at every launch, which takes longer than the launch.
    """
    if not command.device.is_cpu or command.block_dim > 1:
        return lambda: command.launch()
    packed, _ = context._build_cpu_args_structs(command.kernel, command.hooks, command.params, False)
    call = partial(command.hooks.forward, ctypes.byref(command.params[0]), ctypes.byref(packed))
    call.command = command  # type: ignore[attr-defined]  # owns the module and the arrays
    return call
