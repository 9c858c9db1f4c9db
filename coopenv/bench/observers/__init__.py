"""The benchmark of observers: where records come from, who judges, and what is printed and written."""

from coopenv.bench.observers.comparison import Comparison, compare
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.sources import Source, find_source

__all__ = ["Comparison", "Row", "Source", "compare", "find_source"]
