"""Results as tables for pandas, polars, xarray, CSV and Parquet."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from coopenv.base.errors import CoopenvError, Explained
from coopenv.base.files import replace_text, replacing_file
from coopenv.base.installation import install_command, needing
from coopenv.report.table import Table

if TYPE_CHECKING:
    from pandas import DataFrame
    from polars import DataFrame as PolarsFrame
    from xarray import Dataset

INSTALL = install_command("tables")


class Tabular(Explained, ABC):
    """A result that other programs take as a table. The methods have the options of `columns`.

    Units of numbers stand in the names of columns (`position_rmse_m`) and in the attributes of pandas and xarray:
    `frame.attrs["units"]`, `dataset["position_rmse_m"].attrs["units"]`.
    """

    _PARTS = ""  # attribute with the names that `result[name]` takes, over which a result is iterated

    @abstractmethod
    def columns(self) -> Table:
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
