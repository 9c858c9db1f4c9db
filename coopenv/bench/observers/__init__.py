"""The benchmark of observers: where records come from, who judges, and what is printed and written."""

from coopenv.bench.observers.choice import find_source
from coopenv.bench.observers.comparison import Comparison, compare
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.sources import Source

__all__ = ["Comparison", "Row", "Source", "compare", "find_source"]
