"""Numbers in tables and figures; `-` for NaN. JSON of results, and arrays in untrusted `.npz` files, checked."""

import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json, to_jsonable_python

from coopenv.base.errors import CoopenvError, DataError, error_text

NONE = "-"
MOST_DECIMALS = 5
FINEST_ERROR = 1e-3  # share of its number below which a standard error is not given by its first digit


def number(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, and no decimals where these do not reach them."""
    if math.isnan(value):
        return NONE
    if 10**digits <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:z.{digits}g}"


def fixed(value: float, decimals: int) -> str:
    """Return a number whose decimals align with those of others below 10; fewer where it is large."""
    if math.isnan(value):
        return NONE
    return f"{value:.{decimals}f}" if value < 10 else f"{value:.1f}" if value < 1e4 else f"{value:.0e}"


def column(values: Sequence[float]) -> list[str]:
    """Return the numbers of a column with equal decimals: two digits of the smallest, three of the largest."""
    sizes = [abs(value) for value in values if math.isfinite(value) and 10.0**-MOST_DECIMALS <= abs(value) < 1e6]
    decimals = 0
    if sizes:
        wanted = max(1 - math.floor(math.log10(min(sizes))), 2 - math.floor(math.log10(max(sizes))))
        decimals = min(max(wanted, 0), MOST_DECIMALS)
    return [_aligned(value, decimals) for value in values]


def _aligned(value: float, decimals: int) -> str:
    if math.isnan(value):
        return NONE
    lost = value != 0.0 and abs(value) < 0.5 * 10.0**-decimals
    return f"{value:.0e}" if lost or abs(value) >= 1e6 else f"{value:z.{decimals}f}"


def seconds(values: Sequence[float]) -> list[str]:
    """Return a column of times, s, to a hundredth of a second; `never` for NaN."""
    return ["never" if math.isnan(value) else f"{value:.2f}" for value in values]


def three_digits(values: Sequence[float]) -> list[str]:
    """Return numbers with three significant digits each."""
    return [number(value, 3) for value in values]


def with_error(value: float, error: float) -> tuple[str, str]:
    """Return a number and its standard error to the same decimal, the first digit of the error; no error for NaN."""
    if not (math.isfinite(value) and math.isfinite(error)):
        return number(value, 3), ""
    places = [_place(max(error, FINEST_ERROR * abs(value)))] + ([_place(value)] if value else [])
    decimals = max(0, -min(places))
    return f"{value:.{decimals}f}", f"{error:.{decimals}f}"


def in_parentheses(value: float, error: float) -> str:
    """Return a number with its standard error in units of the last digit: 0.0123(4) for 0.0123 and 0.0004."""
    shown, spread = with_error(value, error)
    return f"{shown}({spread.replace('.', '').lstrip('0') or 0})" if spread else shown


def _place(value: float) -> int:
    """Return the power of ten of the first digit of a number, rounded to that digit."""
    return int(f"{value:.0e}".partition("e")[2]) if value else 0


def json_text(value: Any) -> str:
    """Return a result as JSON text; null for NaN and infinity."""
    return to_json(value, indent=2, inf_nan_mode="null", fallback=plain).decode() + "\n"


def jsonable(value: Any) -> Any:
    """Return a result as plain Python, as `json.dumps` takes it; None for NaN and infinity."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=plain)


def plain(value: Any) -> Any:
    """Return NumPy scalars and arrays as plain data, and anything else as text."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


MOST_UNPACKED = 2**31
"""Bytes that an `.npz` file may unpack to."""
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def members_of(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the parts of an untrusted archive, by name; each unpacks to no more than its stated size by `read(size)`.

    Raises:
        DataError: a part is twice in it, or packed in a way (bzip2, LZMA) that Python unpacks without a limit.
    """
    members = {part.filename: part for part in archive.infolist()}
    plain = all(part.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for part in members.values())
    if not plain or len(members) < len(archive.infolist()):
        raise DataError(f"{archive.filename}: a part is in it twice, or packed by neither of: stored, deflated")
    return members


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
            members = {name.removesuffix(".npy"): part for name, part in members_of(archive).items()}
            if sum(part.file_size for part in members.values()) > MOST_UNPACKED:
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
