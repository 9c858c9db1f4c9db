"""Results as columns with units for pandas, polars, xarray, CSV and Parquet; on one line, and as HTML for notebooks."""

from __future__ import annotations

import csv
import math
from abc import ABC, abstractmethod
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from coopenv.base.errors import CoopenvError, Explained, shown
from coopenv.base.files import replace_text, replacing_file
from coopenv.base.installation import install_command, needing

if TYPE_CHECKING:
    from pandas import DataFrame
    from polars import DataFrame as PolarsFrame
    from xarray import Dataset

INSTALL = install_command("tables")
UNITS = {
    "gramian_min_eigenvalue": "mixed",
    "bytes_per_s": "byte/s",
    "us_per_update": "us",
    "_m_per_s": "m/s",
    "_rad_per_s": "rad/s",
    "_per_s": "1/s",
    "_m": "m",
    "_s": "s",
    "_deg": "deg",
    "_rad": "rad",
}
"""End of a column's name to its unit, the first that fits; of other numbers it is 1."""


@dataclass(frozen=True)
class Columns:
    """A table, column by column."""

    values: Mapping[str, Sequence[Any] | np.ndarray]
    """Columns of equal length, by name."""
    keys: tuple[str, ...]
    """Columns whose values together name a row."""
    mixed: tuple[str, ...] = ()
    """Columns of numbers whose units differ from row to row."""

    @classmethod
    def of_rows(cls, rows: Sequence[Any], *keys: str) -> Columns:
        """Return dataclasses of one kind, at least one, with a column per field."""
        return cls({field.name: [getattr(row, field.name) for row in rows] for field in fields(rows[0])}, keys)

    @property
    def units(self) -> dict[str, str]:
        """The unit of every column of numbers that has one."""
        known = {name: values for name, values in self.values.items() if name not in self.mixed}
        numbers = [name for name, values in known.items() if np.asarray(values).dtype.kind in "fiu"]
        return {name: next((u for end, u in UNITS.items() if name.endswith(end)), "1") for name in numbers}

    def csv(self) -> str:
        """Return the table as CSV; numbers that are not finite are empty."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.values)
        columns = (values.tolist() if isinstance(values, np.ndarray) else values for values in self.values.values())
        writer.writerows([_cell(value) for value in row] for row in zip(*columns, strict=True))
        return text.getvalue()


def _cell(value: Any) -> Any:
    return "" if isinstance(value, float) and not math.isfinite(value) else value


class Tabular(Explained, ABC):
    """A result that other programs take as a table. The methods have the options of `columns`.

    Units of numbers stand in the names of columns (`position_rmse_m`) and in the attributes of pandas and xarray:
    `frame.attrs["units"]`, `dataset["position_rmse_m"].attrs["units"]`.
    """

    _PARTS = ""  # attribute with the names that `result[name]` takes, over which a result is iterated

    @abstractmethod
    def columns(self) -> Columns:
        """Return the table."""

    def __iter__(self) -> Iterator[str]:
        return map(str, getattr(self, self._PARTS))

    def __len__(self) -> int:
        return len(getattr(self, self._PARTS))

    def __array__(self, *args: Any, **options: Any) -> NoReturn:
        """Refuse, as `pandas.DataFrame(result)` asks for this: columns differ in type."""
        raise CoopenvError(f"{type(self).__name__} is not an array: to_pandas() returns its table")

    def __arrow_c_stream__(self, schema: Any = None) -> Any:
        """Return the table for programs that read Arrow, as `polars.DataFrame(result)` does."""
        return self.to_polars().__arrow_c_stream__(schema)

    def to_pandas(self, **options: Any) -> DataFrame:
        """Return the table for pandas. Raises CoopenvError: it is not installed."""
        with needing(f"a table of pandas needs pandas: {INSTALL}"):
            from pandas import DataFrame
        table = self.columns(**options)
        frame = DataFrame(dict(table.values))
        frame.attrs["units"] = table.units
        return frame

    def to_polars(self, **options: Any) -> PolarsFrame:
        """Return the table for polars. Raises CoopenvError: it is not installed."""
        with needing(f"a table of polars needs polars: {INSTALL}"):
            import polars
        return polars.DataFrame(dict(self.columns(**options).values))

    def to_xarray(self, **options: Any) -> Dataset:
        """Return the table over its keys as axes, for xarray. Raises CoopenvError: it is not installed."""
        with needing(f"a dataset of xarray needs xarray and pandas: {INSTALL}"):
            import xarray  # noqa: F401 (pandas imports it late)
        table = self.columns(**options)
        frame = self.to_pandas(**options)
        found: Dataset = frame.set_index([*table.keys]).to_xarray()
        found = found.sel({key: list(dict.fromkeys(frame[key])) for key in table.keys})  # pandas sorts them
        for name, unit in table.units.items():
            found[name].attrs["units"] = unit
        return found

    def to_csv(self, path: str | Path | None = None, **options: Any) -> str:
        """Return the table as CSV, and write it where a path is given.

        Raises:
            OutputError: the file cannot be written.
        """
        return written(self.columns(**options).csv(), path)

    def to_parquet(self, path: str | Path, **options: Any) -> None:
        """Write the table as Parquet, units included.

        Raises:
            CoopenvError: pandas or pyarrow is not installed, or the file cannot be written.
        """
        frame = self.to_pandas(**options)
        with needing(f"Parquet needs pyarrow: {INSTALL}"), replacing_file(path) as new:
            frame.to_parquet(new, engine="pyarrow")


def written(text: str, path: str | Path | None) -> str:
    """Return a text, which is also written where a path is given."""
    if path is not None:
        replace_text(path, text)
    return text


WIDTH = 110
"""Characters on a line of a notebook."""


def one_line(kind: object, title: str, facts: Mapping[str, object]) -> str:
    """Return the `repr` of an object: `Kind('title', fact=value, ...)`."""
    return f"{type(kind).__name__}({', '.join([repr(title), *(f'{key}={shown(facts[key])}' for key in facts)])})"


def facts_html(title: str, facts: Mapping[str, object]) -> str:
    """Return a heading, and a table with a line per fact."""
    rows = "".join(f"<tr><th>{escape(key)}</th><td>{escape(str(fact))}</td></tr>" for key, fact in facts.items())
    return f"<b>{escape(title)}</b><table>{rows}</table>"


def terminal_html(printable: Any) -> str:
    """Return rich's output of an object, its alignment kept."""
    from coopenv.base.terminal import Terminal

    console = Terminal(file=StringIO(), record=True, width=WIDTH)
    console.print(printable)
    return console.export_html(inline_styles=True, code_format='<pre style="line-height: 1.2">{code}</pre>')


def picture_html(picture: Any) -> str:
    """Return a figure of Matplotlib, or pixels (H, W, 3) uint8, as a picture in the page itself."""
    data = BytesIO()
    if hasattr(picture, "savefig"):
        picture.savefig(data, format="png", dpi=100)
    else:
        from PIL import Image

        Image.fromarray(picture).save(data, "png")
    return f'<img style="max-width: 100%" src="data:image/png;base64,{b64encode(data.getvalue()).decode()}">'
