"""The figures of a comparison by kind, and as files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from coopenv.bench.observers.exports import FORMATS
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.summary_figures import cost_figure, variant_figure
from coopenv.bench.observers.time_figures import error_figure, nees_figure
from coopenv.errors import CoopenvError
from coopenv.files import replacing_file
from coopenv.viz.style import DPI

KINDS: dict[str, Callable[[Leaderboard, str, float | None], Figure | None]] = {
    "errors": error_figure,
    "consistency": nees_figure,
    "variants": variant_figure,
    "cost": cost_figure,
}
"""Each of a board, one of its variants and a width in inches (None: a page's); None where nothing is to draw."""


def save(figure: Figure, path: Path, kind: str | None = None) -> None:
    """Write a figure.

    Args:
        figure: what to write.
        path: of the file.
        kind: one of `FORMATS`; None: as the path ends.

    Raises:
        CoopenvError: another format, or the file cannot be written.
    """
    form = kind or path.suffix.removeprefix(".")
    if form not in FORMATS:
        raise CoopenvError(f"{path}: unknown format '{form}' of a figure; known: {', '.join(FORMATS)}")
    stamp = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}[form]  # the same figure is the same file
    with replacing_file(path) as new:
        figure.savefig(new, dpi=DPI, format=form, metadata={stamp: None})
