"""Map Warp functions, generic in the precision, over NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from coopenv.world.launch import compiler_options, launch, start_warp
from coopenv.world.warp_internals import scalar_of

DTYPES = ("float64", "float32")
"""Of what a file holds against an oracle one test takes both precisions, the others float64."""
EPSILON = {"float64": np.finfo(np.float64).eps, "float32": np.finfo(np.float32).eps}
WHOLE = {"b": wp.bool, "i": wp.int32, "u": wp.uint32, "U": wp.uint64, "u4": wp.types.vector(4, wp.uint32)}

start_warp()


class Calls:
    """The Warp functions that a test file calls, as kernels of one Warp module.

    Args:
        name: of the file.
        both: signatures of the functions that are called in both precisions, "3 33 > 1" for a function of a vector and
            a matrix that returns a scalar, by function; `WHOLE` lists the types that are not floats.
        wide: signatures of those that are called in float64 alone.
    """

    def __init__(
        self, name: str, both: Mapping[wp.Function, str], wide: Mapping[wp.Function, str] | None = None
    ) -> None:
        self._module = wp.get_module(f"{name}.calls")
        self._module.options |= {"enable_backward": False, **compiler_options()}
        self._kernels: dict[tuple[wp.Function, str], tuple[wp.Kernel, list[Any], list[Any]]] = {}
        for dtype, functions in (("float64", {**both, **(wide or {})}), ("float32", both)):
            for function, signature in functions.items():
                types = [[_type(word, dtype) for word in part.split()] for part in signature.split(">")]
                self._kernels[function, dtype] = (self._kernel(function, dtype, *types), *types)

    def _kernel(self, function: wp.Function, dtype: str, inputs: list[Any], outputs: list[Any]) -> wp.Kernel:
        given, found = ([f"{letter}{i}" for i in range(len(x))] for letter, x in (("x", inputs), ("y", outputs)))
        values = [f"v{i}" for i in range(len(outputs))]
        source = (
            f"def mapped({', '.join(f'{a}: T{a}' for a in given + found)}):\n"
            f"    i = wp.tid()\n"
            f"    {', '.join(values)} = function({', '.join(f'{x}[i]' for x in given)})\n"
            + "".join(f"    {y}[i] = {v}\n" for y, v in zip(found, values, strict=True))
        )
        types = {f"T{a}": wp.array(dtype=t) for a, t in zip(given + found, inputs + outputs, strict=True)}
        namespace = {"wp": wp, "function": function, **types}
        exec(source, namespace)
        return wp.Kernel(namespace["mapped"], key=f"{function.key}_{dtype}", source=source, module=self._module)

    def __call__(self, function: wp.Function, dtype: str, *inputs: ArrayLike) -> Any:
        """Return what a Warp function returns for each entry of the leading axis, floats as float64.

        Args:
            function: called with scalars, vectors and matrices.
            dtype: precision of the floats.
            inputs: arrays with a leading axis; those of length 1 are repeated.
        """
        kernel, given, found = self._kernels[function, dtype]
        values = [np.asarray(value) for value in inputs]
        count = max(map(len, values))
        arrays = [_array(value, kind, count) for value, kind in zip(values, given, strict=True)]
        results = [wp.zeros(count, dtype=kind, device="cpu") for kind in found]
        launch(kernel, dim=count, inputs=arrays, outputs=results, device="cpu")
        numbers = [_numpy(array) for array in results]
        return numbers[0] if len(numbers) == 1 else tuple(numbers)


def _type(word: str, dtype: str) -> Any:
    """Return the Warp type of a word of a signature: "3" is a vector, and "63" a matrix of six rows."""
    scalar = getattr(wp, dtype)
    if word in WHOLE:
        return WHOLE[word]
    if word == "1":
        return scalar
    sizes = tuple(map(int, word))
    return wp.types.matrix(sizes, scalar) if len(sizes) == 2 else wp.types.vector(*sizes, scalar)


def _array(value: np.ndarray, kind: Any, count: int) -> wp.array:
    filled = np.broadcast_to(value, (count, *value.shape[1:]))
    return wp.array(
        np.ascontiguousarray(filled, wp.dtype_to_numpy(scalar_of(kind))),
        dtype=kind,
        device="cpu",
    )


def _numpy(array: wp.array) -> np.ndarray:
    values = array.numpy()
    return values.astype(float) if values.dtype.kind == "f" else values
