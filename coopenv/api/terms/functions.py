"""From the row of a term to its Warp function."""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from coopenv import user_code
from coopenv.errors import CoopenvError
from coopenv.scenario.terms import Term


def term_function(what: str, row: Term, records: int) -> wp.Function:
    """Return the function of a row, made a Warp function if it is a plain one.

    Args:
        what: the term, for errors.
        row: names the function or holds it.
        records: how many it has to take.

    Raises:
        CoopenvError: it does not exist, cannot be loaded, or takes something else.
    """
    function = row.function
    if isinstance(function, str):
        linecache.checkcache()  # Warp reads the source of a file that may have changed
        try:
            function = user_code.load(function)
        except CoopenvError as error:
            raise CoopenvError(f"{what}: {error}") from None
    if not isinstance(function, wp.Function):
        if not inspect.isfunction(function) or function.__name__ == "<lambda>":
            raise CoopenvError(f"{what}: expected a function with a name, got {function!r:.60}")
        function = _warp_function(function)
    taken = len(function.input_types)
    if taken != records:
        raise CoopenvError(f"{what}: its function takes {taken} records, expected {records}; see docs/terms.md")
    return function


@cache
def _warp_function(function: Callable[..., Any]) -> wp.Function:
    for name in inspect.signature(function).parameters:
        function.__annotations__.setdefault(name, Any)
    made: Any = wp.func(function)  # typed as what it wraps
    return made  # type: ignore[no-any-return]
