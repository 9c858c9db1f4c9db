"""What the figures of a comparison share: a page, a legend above the panels, and below them what was compared."""

from collections.abc import Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.figure import Figure

from coopenv.errors import CoopenvError
from coopenv.viz import style
from coopenv.viz.style import INK, NORMAL, SMALL, new_figure

PAGE = 10.5
"""inches, the width of a figure unless another one is asked for."""
NOTE = "#595959"
"""Colour of small print; its contrast on white is 7."""
TEXT: dict[str, Any] = {"fontsize": NORMAL, "color": INK}
_LEGEND_MARK, _LEGEND_LETTER = 0.45, 0.06  # inches


def canvas(width: float | None, height: float, note: str) -> tuple[Figure, float]:
    """Return an empty figure that arranges itself, with a note in small print below, and its width, inches.

    Raises:
        CoopenvError: a width that nothing can be drawn in.
    """
    inches = PAGE if width is None else float(width)
    if not 2.0 <= inches <= 50.0:
        raise CoopenvError(f"width {inches:g}: expected 2 to 50 inches")
    figure = new_figure(inches, height)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03, wspace=0.02, hspace=0.02)
    figure.supxlabel(note, x=0.99, ha="right", fontsize=SMALL - 1.0, color=NOTE)
    return figure, inches


def fitting(width: float, each: float, most: int) -> int:
    """Return how many panels of a width stand side by side."""
    return max(1, min(most, int(width / each)))


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put a legend above the panels."""
    length = sum(_LEGEND_MARK + _LEGEND_LETTER * len(str(handle.get_label())) for handle in handles)
    columns = fitting(float(figure.get_figwidth()), length / len(handles), len(handles))
    spacing: dict[str, Any] = {"handlelength": 2.2, "columnspacing": 1.6}
    style.legend(figure, handles, "outside upper center", ncols=columns, fontsize=SMALL + 0.5, **spacing)
