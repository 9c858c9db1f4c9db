"""The benchmark of observers: records with faults, judged against the truth and the bounds, as tables and files."""

from typing import TYPE_CHECKING

from coopenv.base import lazy_names

if TYPE_CHECKING:
    from coopenv.bench.observers.comparison import Comparison, compare
    from coopenv.bench.observers.rows import Row
    from coopenv.bench.observers.sources import RecordSource, find_source
else:
    __getattr__, __dir__ = lazy_names(__name__)

__all__ = ["Comparison", "RecordSource", "Row", "compare", "find_source"]
