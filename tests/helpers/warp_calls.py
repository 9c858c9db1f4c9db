"""Map Warp functions, generic in the precision, over NumPy arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from coopenv.world.launch import start_warp

DTYPES = ("float64", "float32")
WIDE = ("float64",)
"""Of what a file holds against an oracle one test takes both precisions, the others this one."""
EPSILON = {"float64": np.finfo(np.float64).eps, "float32": np.finfo(np.float32).eps}

start_warp()


def call(function: wp.Function, dtype: str, *inputs: ArrayLike) -> Any:
    """Return what a Warp function returns for each entry of the leading axis, floats as float64.

    Args:
        function: called with scalars, vectors and matrices, by the shape behind the leading axis.
        dtype: precision of the inputs that are floats; integers keep their type.
        inputs: arrays with a leading axis; those of length 1 are repeated.
    """
    wp.get_module(f"map_{function.key}").options["enable_backward"] = False
    count = max(len(np.asarray(value)) for value in inputs)
    # At least two, since Warp would compile another kernel for arrays of length one.
    arrays = [_array(np.asarray(value), dtype, max(count, 2)) for value in inputs]
    found = wp.map(function, *arrays, device="cpu")
    results = [_numpy(array)[:count] for array in (found if isinstance(found, list) else [found])]
    return results[0] if len(results) == 1 else tuple(results)


def _array(value: np.ndarray, dtype: str, count: int) -> wp.array:
    """Return (count or 1, ...) values as a Warp array of length `count` in the precision."""
    number = value.dtype if value.dtype.kind in "iu" else np.dtype(dtype)
    scalar, shape = wp.dtype_from_numpy(number), value.shape[1:]
    element = scalar if not shape else wp.types.vector(shape[0], scalar) if len(shape) == 1 else None
    filled = np.broadcast_to(value, (count, *shape)) if len(value) == 1 else value
    return wp.array(
        np.ascontiguousarray(filled, dtype=number), dtype=element or wp.types.matrix(shape, scalar), device="cpu"
    )


def _numpy(array: wp.array) -> np.ndarray:
    values = array.numpy()
    return values.astype(float) if values.dtype.kind == "f" else values
