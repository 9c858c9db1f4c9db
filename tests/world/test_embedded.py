"""Sensing stages of a source are the same at the start of an episode and at every tick."""

import inspect

import pytest
import warp as wp

from coopenv.sources.feed import COSIMULATED, RECORDED, look_cosimulated
from coopenv.world.embedded import SIMULATED, look_around

CALLERS = ("coopenv.world.embedded", "coopenv.sources.feed")
"""Modules that put stages together."""


def called(function: wp.Function) -> list[wp.Function]:
    """Return the Warp functions that a Warp function calls."""
    names, module = function.func.__code__.co_names, inspect.getmodule(function.func)
    return [part for name in names if isinstance(part := getattr(module, name, None), wp.Function)]


def stages(function: wp.Function) -> set[str]:
    """Return the functions of a tick that a function calls, directly or through functions of `CALLERS`."""
    parts = called(function)
    found = {part.func.__name__ for part in parts if "tick" in inspect.signature(part.func).parameters}
    return found.union(*(stages(part) for part in parts if part.func.__module__ in CALLERS))


@pytest.mark.parametrize(
    ("begin", "sense", "expected"),
    [
        (SIMULATED.begin, SIMULATED.look, {"observe", "transmit", "direct_traffic"}),
        (COSIMULATED.begin, look_around, {"observe", "transmit", "direct_traffic"}),
        (RECORDED.begin, RECORDED.arrange, {"recall", "transmit"}),
    ],
)
def test_an_episode_begins_with_the_sensing_stages_of_a_tick(
    begin: wp.Function, sense: wp.Function, expected: set[str]
) -> None:
    assert stages(begin) - {"remember"} == stages(sense) >= expected
    assert look_around in called(look_cosimulated)
