"""Functions that are handed records by reference, and Warp's private interface, which is used in one file."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import coopenv
from coopenv.world import launch
from coopenv.world.warp_internals import device_function


@wp.struct
class Single:
    values: wp.array(dtype=wp.float32)
    step: wp.float32


@wp.struct
class Double:
    values: wp.array(dtype=wp.float64)
    step: wp.float64


@device_function
def stepped(state: Any, i: int, times: int):
    return state.values[i] + state.step * type(state.step)(times)


@device_function
def advance(state: Any, i: int, times: int):
    state.values[i] = stepped(state, i, times)


def make_twice(function: Any) -> Any:
    """Return a function that closes over another one, as an observer's do."""

    @device_function
    def twice(state: Any, i: int, times: int):
        function(state, i, times)
        function(state, i, times)

    return twice


advance_twice = make_twice(advance)


def move(state: Any, times: int):
    advance_twice(state, wp.tid(), times)


def start_of(record: Any, dtype: Any) -> Any:
    state = record()
    state.values = wp.array([1.0, 2.0, 3.0], dtype=dtype, device="cpu")
    state.step = 0.5
    return state


@pytest.mark.parametrize(("record", "dtype"), [(Single, wp.float32), (Double, wp.float64)])
def test_functions_write_into_the_arrays_of_records(record: Any, dtype: Any) -> None:
    state = start_of(record, dtype)
    wp.launch(launch.kernel(move, dtype.__name__), dim=3, inputs=[state, 3], device="cpu")
    np.testing.assert_allclose(state.values.numpy(), [4.0, 5.0, 6.0])


def test_records_are_handed_over_by_reference_and_numbers_are_not() -> None:
    for function in (advance, advance_twice, stepped):
        overload = function.get_overload([Single, wp.int32, wp.int32], {})
        assert overload.input_types == {"state": wp.ref[Single], "i": wp.int32, "times": wp.int32}


def test_what_is_no_record_stays_a_value() -> None:
    @device_function
    def increased(state: Any):
        return state + type(state)(1.0)

    assert increased.get_overload([wp.float32], {}).input_types == {"state": wp.float32}


def test_the_threshold_of_inlining_replaces_that_of_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = "-march=native -mllvm=-inline-threshold=9000 -O1 -mllvm=-slp-recursion-max-depth=4"
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    monkeypatch.setattr(launch, "INLINE_THRESHOLD", 7)
    assert launch.compiler_options()["cpu_compiler_flags"] == "-march=native -O1 -mllvm=-inline-threshold=7"


@pytest.mark.parametrize("flags", [None, "", "-march=native -O0"])
def test_flags_of_the_user_stay(monkeypatch: pytest.MonkeyPatch, flags: str | None) -> None:
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    assert launch.compiler_options() == {}


PRIVATE = {"_cls", "_wp_scalar_type_", "native_func", "hooks", "adj", "runtime"}
PACKAGE = Path(coopenv.__file__).parent
OWN = PACKAGE / "world" / "warp_internals.py"


def private_uses(path: Path) -> list[int]:
    """Return the lines of a file in which private names of Warp stand, as attributes, texts or imports."""
    uses = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if (
            (isinstance(node, ast.Attribute) and (node.attr in PRIVATE or (node.attr == "_src")))
            or (isinstance(node, ast.Attribute) and node.attr == "__class__" and isinstance(node.ctx, ast.Store))
            or (isinstance(node, ast.Constant) and node.value == "_wp_scalar_type_")
            or (isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp._"))
            or (isinstance(node, ast.Import) and any(alias.name.startswith("warp._") for alias in node.names))
        ):
            uses.append(node.lineno)
    return uses


def test_no_other_file_uses_the_private_interface_of_warp() -> None:
    assert private_uses(OWN)
    found = {str(path): lines for path in PACKAGE.rglob("*.py") if path != OWN and (lines := private_uses(path))}
    assert found == {}
