"""Records of arrays: every field states its axes once, a letter each, and is allocated by them."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import warp as wp


def array(axes: str, dtype: Any) -> Any:
    """Return the annotation of a struct's field: an array with these axes, a letter each, for example "WN"."""
    annotation: Any = wp.array(dtype=dtype, ndim=len(axes))
    annotation.axes = axes
    return annotation


def extended(record: Any, name: str, doc: str, **more: Any) -> Any:
    """Return a struct with the fields of another one and more, declared with `array`."""
    annotations = {**{field: var.type for field, var in record.vars.items()}, **more}
    return wp.struct(
        type(name, (), {"__doc__": doc, "__module__": record.cls.__module__, "__annotations__": annotations})
    )


def fields(record: Any) -> dict[str, Any]:
    """Return the arrays that a record's struct declares with `array`, by name: annotations with `axes` and `dtype`."""
    return {name: var.type for name, var in record.vars.items() if hasattr(var.type, "axes")}


def size_of(record: Any, sizes: Mapping[str, int]) -> int:
    """Return how many bytes a record's arrays take."""
    arrays = fields(record).values()
    return sum(math.prod(sizes[a] for a in x.axes) * int(wp.types.type_size_in_bytes(x.dtype)) for x in arrays)


def allocate(record: Any, sizes: Mapping[str, int], device: str, shared: str = "") -> Any:
    """Return a record of zeros of a struct whose fields are declared with `array`; `sizes` are lengths by letter.

    Along the axis `shared`, where it comes second, all indices stand for one and the same row: whoever needs the rows
    of one vehicle alone can then index them by the vehicle without room for the others'.
    """
    result = record()
    for name, field in fields(record).items():
        shape = [sizes[axis] for axis in field.axes]
        if shared and field.axes[1:2] == shared:
            row = wp.zeros([shape[0], 1, *shape[2:]], dtype=field.dtype, device=device)
            setattr(result, name, repeated(row, 1, shape[1]))
        else:
            setattr(result, name, wp.zeros(shape, dtype=field.dtype, device=device))
    return result


class Part:
    """One field of the entries of an array of structs, read and written as an array of its own."""

    def __init__(self, array: Any, path: tuple[str, ...]) -> None:
        self._array, self._path = array, path

    def numpy(self) -> np.ndarray:
        """Return it on the host, without a copy on the CPU."""
        return self._of(self._array.numpy())

    def assign(self, values: np.ndarray) -> None:
        """Overwrite it."""
        host = self._array.numpy()
        self._of(host)[...] = values
        if not self._array.device.is_cpu:
            self._array.assign(host)

    def _of(self, host: np.ndarray) -> np.ndarray:
        for name in self._path:
            host = host[name]
        return host


def parts(record: Any, struct: Any) -> dict[str, Any]:
    """Return the arrays of a record by name, and of arrays of structs every field by a name with dots."""
    arrays = {name: getattr(record, name) for name in fields(struct)}
    paths = [(name, path) for name, array in arrays.items() for path in _paths(array.numpy().dtype)]
    return {".".join((name, *path)): Part(arrays[name], path) if path else arrays[name] for name, path in paths}


def _paths(dtype: np.dtype) -> Iterator[tuple[str, ...]]:
    """Yield the way to every field of a structured type that has no fields itself."""
    if dtype.names is None:
        yield ()
    for name in dtype.names or ():
        yield from ((name, *path) for path in _paths(dtype[name]))


def repeated(row: Any, axis: int, count: int) -> Any:
    """Return an array that has one entry along an axis as one that seems to have it `count` times."""
    shape, strides = list(row.shape), list(row.strides)
    shape[axis], strides[axis] = count, 0
    result: Any = wp.array(ptr=row.ptr, shape=tuple(shape), strides=tuple(strides), dtype=row.dtype, device=row.device)
    result.row = row  # owns the memory
    return result
