"""What Warp compiles after the rules for its source computes what the program says, on arrays with gaps, too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from coopenv.world.launch import module_kernels, start_warp
from coopenv.world.model import precision
from coopenv.world.warp_internals import SOURCE_RULES, device_function, outlined

start_warp()


@wp.struct
class Table:
    """A record of arrays, one of records with arrays' elements among them."""

    rows: wp.array2d(dtype=wp.float32)
    offset: wp.array(dtype=wp.vec2)


def ours(function: Any) -> Any:
    """Return a function that counts as one of this package."""
    function.__module__ = "coopenv.samples"
    return function


@outlined
@ours
def total(table: Any, row: int) -> float:
    """Return the sum of a row, and write the row's number into its first place."""
    found = table.rows[row, 0]
    for k in range(1, table.rows.shape[1]):
        found += table.rows[row, k]
    table.rows[row, 0] = float(row)
    return found


@device_function
@ours
def shifted(table: Any, row: int) -> wp.vec2:
    """Return an offset, read through a name of its array, that is moved by what was written before."""
    offset = table.offset
    rows = table.rows
    return offset[row] + wp.vec2(rows[row, 0], 0.0)


@ours
def fill(table: Table, out: wp.array2d(dtype=wp.float32)):
    """Write the sum, and an offset that depends on what the sum has written. One thread per row."""
    row = wp.tid()
    kept = table
    out[row, 0] = total(table, row)
    place = shifted(kept, row)
    out[row, 1] = place[0]
    out[row, 2] = place[1]


@ours
def exchange(table: Table, out: wp.array2d(dtype=wp.float32)):
    """Write to a field of a record."""
    table.rows = out


def test_a_record_is_not_written_to() -> None:
    """Each thread would find what the one before has written."""
    made = module_kernels("samples_exchanged", precision("float32"), exchange)["exchange"]
    with pytest.raises(TypeError, match="exchange: writes to a field of 'table', a record of arrays"):
        wp.launch(made, 1, inputs=[Table(), wp.zeros((1, 1), dtype=wp.float32, device="cpu")], device="cpu")


@pytest.mark.parametrize("step", [1, 2, 3])
def test_records_and_arrays_are_read_in_place(step: int) -> None:
    """With `step` above 1 the arrays have gaps, of which Warp compiles a version of its own."""
    made = module_kernels("samples_in_place", precision("float32"), fill)["fill"]
    assert made.module.options["source_rules"] == SOURCE_RULES
    values = np.arange(24.0, dtype=np.float32).reshape(6, 4)
    offsets = np.arange(12.0, dtype=np.float32).reshape(6, 2)
    table, out = Table(), wp.zeros((6, 3), dtype=wp.float32, device="cpu")
    table.rows = wp.array(values.copy(), dtype=wp.float32, device="cpu")[::step]
    table.offset = wp.array(offsets, dtype=wp.vec2, device="cpu")[::step]
    wp.launch(made, 6 // step, inputs=[table, out[::step]], device="cpu")
    row = np.arange(6 // step)
    expected = np.zeros((6, 3), np.float32)
    expected[::step][:, 0] = values[::step].sum(axis=1)
    expected[::step][:, 1:] = offsets[::step] + np.column_stack([row, 0 * row])
    assert np.array_equal(out.numpy(), expected)
    assert table.rows.numpy()[:, 0] == pytest.approx(row)
