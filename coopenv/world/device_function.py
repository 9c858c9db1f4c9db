"""Warp functions that take records of arrays by reference.

A record of arrays, the state for example, has some kilobytes, as every array has a descriptor. Warp hands functions
copies of their arguments, which the compiler removes from small functions alone: in an observer of many functions they
take a fifth of the time. Warp's references (`wp.ref`) are for arguments whose type is written down. Here types follow
from the kernel, so that each overload gets its references when it is made.
"""

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

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
