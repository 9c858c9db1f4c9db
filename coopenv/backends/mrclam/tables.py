"""The files of one MR.CLAM sub-dataset: columns of numbers, comments behind `#`, times in absolute seconds."""

import os
import re
import warnings
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError, suggest

NAMES = tuple(f"mrclam_{number}" for number in range(1, 10))
ENVIRONMENT_VARIABLE = "COOPENV_DATA"

MAX_PAUSE_S = 3600.0  # between two rows; more is a broken time stamp
MAX_LENGTH_S = 6 * 3600.0
"""Longest time that a sub-dataset may span, whose clocks agree; the longest one takes 40 minutes."""
MAX_DISORDER_S = 1.0  # by which a row may be late, as some are that were published; more is a broken time stamp


def find_folder(name: str, data: str | Path | None = None) -> Path:
    """Return the folder of a sub-dataset: `data` or a folder in it, by default what COOPENV_DATA says.

    Raises:
        DataError: unknown name, nothing said where the data are, or they are not there.
    """
    if name not in NAMES:
        raise DataError(f"unknown data set {name!r}{suggest(str(name), NAMES)}; there are {NAMES[0]} .. {NAMES[-1]}")
    where = data if data is not None else os.environ.get(ENVIRONMENT_VARIABLE)
    if not where:
        raise DataError(f"{name}: name its folder with --data DIR or {ENVIRONMENT_VARIABLE} (docs/data.md)")
    root = Path(where).expanduser()
    wanted = f"MRCLAM_Dataset{name.removeprefix('mrclam_')}"
    if (root / wanted).is_dir():
        return root / wanted
    if not root.is_dir():
        raise DataError(f"{name}: folder {root} does not exist")
    other = re.fullmatch(r"MRCLAM_Dataset\d+", root.resolve().name)
    if root.resolve().name == wanted or ((root / "Barcodes.dat").is_file() and other is None):
        return root
    if other:
        raise DataError(f"{name}: {root} is another sub-dataset, expected {wanted}")
    raise DataError(f"{name}: neither {wanted} nor Barcodes.dat in {root}")


class Table:
    """A file's rows of finite numbers, which know their lines."""

    unknown = 0  # rows left out because a value in them is not known
    late = 0  # rows that stood below a later one
    _kept: NDArray[np.int64] | None = None  # of each row, which of the file's it is; None: the same

    def __init__(self, path: Path, columns: int, least: int, gaps: bool = False) -> None:
        """Read a file that has so many columns, and at least so many rows; a DataError names a line that is not so.

        Where `gaps` are allowed, rows are left out that have NaN behind their first column.
        """
        try:
            self.path, self._text = path, path.read_text(encoding="latin-1")
        except OSError as error:
            why = f"cannot be read ({error.strerror})" if path.is_file() else "no such file"
            raise DataError(f"{path}: {why}") from None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without rows
                self.values = np.loadtxt(StringIO(self._text), dtype=np.float64, ndmin=2)
        except ValueError:
            self._explain(columns)
        if self.values.size == 0:
            self.values = np.empty((0, columns))
        if self.values.shape[1] != columns:
            self._explain(columns)
        if gaps:
            known = ~np.isnan(self.values[:, 1:]).any(axis=1)
            self.unknown = int(np.count_nonzero(~known))
            self._take(np.flatnonzero(known))
        for row in np.flatnonzero(~np.isfinite(self.values).all(axis=1)).tolist():
            self.refuse(row, "a value is not finite")
        if len(self.values) < least:
            end = max(len(self._text.rstrip("\n").split("\n")), 1)
            raise DataError(f"{path}:{end}: {len(self.values)} rows of data, expected at least {least}")
        if len(self.values) > 1 and not self._text.endswith("\n"):  # cut in the middle of a number?
            above, (number, last) = self._rows[-2][1][-1], (self._rows[-1][0], self._rows[-1][1][-1])
            if number == self._text.count("\n") + 1 and len(last.partition(".")[2]) < len(above.partition(".")[2]):
                self.refuse(-1, f"cut off in the middle of the last number {last!r}")

    @cached_property
    def _rows(self) -> list[tuple[int, list[str]]]:
        """Number and fields of each line that holds data."""
        split = ((number, line.partition("#")[0].split()) for number, line in enumerate(self._text.split("\n"), 1))
        return [(number, fields) for number, fields in split if fields]

    def _explain(self, columns: int) -> NoReturn:
        """Blame the line that the fast reader has refused."""
        for row, (_, fields) in enumerate(self._rows):
            if len(fields) != columns:
                self.refuse(row, f"{len(fields)} columns, expected {columns}")
            for field in fields:
                try:
                    float(field)
                except ValueError:
                    self.refuse(row, f"{field[:40]!r} is not a number")
        raise DataError(f"{self.path}: not a table of {columns} columns of numbers")

    def refuse(self, row: int, why: str) -> NoReturn:
        """Blame a row of data, by its line in the file."""
        number = row if self._kept is None else self._kept[row]
        raise DataError(f"{self.path}:{self._rows[number][0]}: {why}")

    def sort(self, late: NDArray[np.bool_]) -> None:
        """Put rows in the order of their first column, and remember how many were late."""
        self.late = int(np.count_nonzero(late))
        if self.late:
            self._take(np.argsort(self.values[:, 0], kind="stable"))

    def _take(self, rows: NDArray[np.int64]) -> None:
        self.values, self._kept = self.values[rows], rows if self._kept is None else self._kept[rows]

    def whole(self, column: int) -> list[int]:
        """Return a column of whole numbers. Raises DataError: a number is not whole."""
        values = self.values[:, column]
        for row in np.flatnonzero(values != np.round(values)).tolist():
            self.refuse(row, "subject and barcode numbers must be whole")
        return [int(value) for value in values]


def timed(path: Path, columns: int, least: int) -> Table:
    """Return a table whose first column is the time, s, which does not run ahead by hours.

    Rows that stand up to a second too late are put in order, and rows with NaN are left out; the table counts both. A
    DataError names a row that is later.
    """
    table = Table(path, columns, least, gaps=True)
    t = table.values[:, 0]
    behind = np.maximum.accumulate(t) - t
    for row in np.flatnonzero(behind >= MAX_DISORDER_S).tolist():
        why = f"time runs backwards, {t[row]:.14g} after {t[row - 1]:.14g}"
        table.refuse(row, f"{why}; rows may be out of order by less than {MAX_DISORDER_S:g} s")
    table.sort(behind > 0)
    t = table.values[:, 0]
    steps, length = np.diff(t, prepend=t[:1]), t - t[:1]
    for row in np.flatnonzero(steps > MAX_PAUSE_S).tolist():
        table.refuse(row, f"{steps[row]:g} s after the row above, at most {MAX_PAUSE_S:g}")
    for row in np.flatnonzero(length > MAX_LENGTH_S).tolist():
        table.refuse(row, f"{length[row]:g} s after the first row, at most {MAX_LENGTH_S:g}")
    return table
