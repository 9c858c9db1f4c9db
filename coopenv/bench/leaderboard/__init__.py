"""The benchmark of observers: where records come from, who judges, and what is printed and written."""

from coopenv.bench.leaderboard.compare import Outcome, compare
from coopenv.bench.leaderboard.rows import Row
from coopenv.bench.leaderboard.sources import Source, find_source

__all__ = ["Outcome", "Row", "Source", "compare", "find_source"]
