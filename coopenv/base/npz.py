"""Arrays in untrusted `.npz` files, checked; a file of its own, because the gate of a car loads no NumPy."""

import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from coopenv.base.errors import CoopenvError, DataError, error_text

MOST_UNPACKED = 2**31
"""Bytes that an `.npz` file may unpack to."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(
    path: Path, what: str, table: Mapping[str, str], lengths: Mapping[str, Sequence[int]] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an untrusted `.npz` file; sizes, kinds and shapes are checked before memory is allocated.

    Args:
        path: of the file.
        what: it is, as errors call it.
        table: by name of an array the kinds of its dtype and its axes, for example "f K N 3". Axes of the same letter
            have the same length. With "f?" files of older versions may lack it; it is infinite then.
        lengths: by letter which lengths are possible; None: any.

    Raises:
        DataError: there is no such file, it unpacks to more than `MOST_UNPACKED`, or an array is missing or other than
            in the table.
    """
    possible = dict(lengths or {})
    try:
        with zipfile.ZipFile(path) as archive:
            members = {part.filename.removesuffix(".npy"): part for part in archive.infolist()}
            if sum(part.file_size for part in archive.infolist()) > MOST_UNPACKED:
                raise DataError(f"{path}: unpacks to more than {MOST_UNPACKED >> 30} GiB")
            if missing := [name for name, rule in table.items() if name not in members and "?" not in rule]:
                raise DataError(f"{path}: not a {what}, missing: {', '.join(missing)}")
            found = {}
            for name, rule in table.items():
                if name not in members:
                    continue
                with archive.open(members[name]) as stream:
                    shape, _, dtype = _HEADERS[np.lib.format.read_magic(stream)](stream)
                if not _fits(shape, dtype, rule, possible):
                    kinds, *axes = rule.split()
                    wanted = ", ".join(" or ".join(map(str, possible.get(axis, (axis,)))) for axis in axes)
                    raise DataError(f"{path}: {name}: {dtype} {shape} is not of kind {kinds} and shape ({wanted})")
                if math.prod(shape) * dtype.itemsize > members[name].file_size:
                    raise EOFError
                with archive.open(members[name]) as stream:
                    found[name] = np.lib.format.read_array(stream, allow_pickle=False)
            for name in table.keys() - found.keys():
                axes = table[name].split()[1:]
                found[name] = np.full([int(axis) if axis.isdigit() else possible[axis][0] for axis in axes], np.inf)
            return found
    except CoopenvError:
        raise
    except (zipfile.BadZipFile, EOFError, zlib.error):
        raise DataError(f"{path}: not a readable {what}: it is cut off, damaged, or of another kind") from None
    except Exception as error:  # any error of NumPy and zipfile for malformed files
        raise DataError(
            f"{path}: not a readable {what} ({getattr(error, 'strerror', None) or error_text(error)})"
        ) from None


def _fits(shape: tuple[int, ...], dtype: np.dtype, rule: str, possible: dict[str, Sequence[int]]) -> bool:
    """Return whether an array is as its rule says; lengths of letters that are met first are kept in `possible`."""
    kinds, *axes = rule.split()
    if dtype.kind not in kinds or len(shape) != len(axes):
        return False
    return all(
        length == int(axis) if axis.isdigit() else length in possible.setdefault(axis, (length,))
        for length, axis in zip(shape, axes, strict=True)
    )
