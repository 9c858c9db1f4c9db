"""Replay of recorded launches through Warp's private interface.

`context._build_cpu_args_structs` packs the arguments of a launch, `command.hooks.forward` is the compiled kernel. Both
are private, so that `pyproject.toml` bounds the version of Warp; without them `command.launch` does the same, slower.

A record of arrays, the state for example, has some kilobytes, as every array has a descriptor. Warp hands functions
copies of their arguments, which the compiler removes from small functions alone: in an observer of many functions they
take a fifth of the time. Warp's references (`wp.ref`) are for arguments whose type is written down. Here types follow
from the kernel, so that each overload gets its references when it is made.
"""

import ctypes
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import warp as wp
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


RECORDS = ("model", "state", "memory", "record", "results")  # names of arguments that are handed over by reference
_REFERENCE: Any = wp.ref  # generic at run time only


class _ByReference(wp.Function):
    """A Warp function whose overloads take their records by reference."""

    def get_overload(self, arg_types: Any, kwarg_types: Mapping[str, Any]) -> Any:
        """Return the overload for types of arguments, see `wp.Function`."""
        overload: Any = super().get_overload(arg_types, kwarg_types)
        if overload is not None:
            types = {name: _as_handed(name, kind) for name, kind in overload.input_types.items()}
            if types != overload.input_types:
                overload.input_types = types
                overload.adj = type(overload.adj)(overload.func, types, source=overload.adj.source)
        return overload


def _as_handed(name: str, kind: Any) -> Any:
    is_record = name in RECORDS and hasattr(kind, "vars")  # a `wp.struct`
    return _REFERENCE[kind] if is_record else kind


def device_function(function: Callable[..., Any]) -> Any:
    """Return what `wp.func` makes of a function, with arguments that are `RECORDS` by reference.

    For functions that are large or call large ones. Not for those of which derivatives are taken: Warp has none of
    references.
    """
    made = wp.func(function)
    made.__class__ = _ByReference
    return made
