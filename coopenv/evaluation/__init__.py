"""Figures of drivers on held-out worlds, with intervals over worlds."""

from coopenv.evaluation.episodes import Episodes, drive, held_out_seeds
from coopenv.evaluation.metrics import METRICS, Difference, Result, compare_paired, ranking_key, score

__all__ = [
    "METRICS",
    "Difference",
    "Episodes",
    "Result",
    "compare_paired",
    "drive",
    "held_out_seeds",
    "ranking_key",
    "score",
]
