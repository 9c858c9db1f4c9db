"""All figures of a run, written under stable names.

`style` gives Matplotlib's settings for figures of one's own, `restyle` changes a figure of this package:

    import matplotlib.pyplot as plt
    from coopenv.viz import paper

    plt.style.use(paper.style("ieee1"))
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from matplotlib.lines import Line2D
from matplotlib.text import Text

from coopenv.base.errors import CoopenvError, suggest
from coopenv.base.files import writing
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario import Scenario
from coopenv.viz import FIGURE_NAMES
from coopenv.viz import style as house
from coopenv.viz.error_figures import consistency_figure, error_figure, observability_figure
from coopenv.viz.style import save, sign
from coopenv.viz.topology import topology_figure
from coopenv.viz.trajectories import trajectory_figure_2d, trajectory_figure_3d

_MM = 1 / 25.4
_SMALLER = 0.7  # marks in a narrow column
_TIMES = ("Times New Roman", "Nimbus Roman", "TeX Gyre Termes", "Liberation Serif", "STIXGeneral")
_HELVETICA = ("Arial", "Helvetica", "Nimbus Sans", "TeX Gyre Heros", "Liberation Sans", "DejaVu Sans")


class Column(NamedTuple):
    """How a journal sets figures of one width."""

    inches: float
    size: float
    """pt, of labels; ticks and legends are a sixth smaller."""
    fonts: tuple[str, ...]
    """By preference; Matplotlib brings the last one."""
    mathematics: str
    """Matplotlib's set of fonts for formulas."""

    @property
    def font(self) -> str:
        """The first of the fonts that is installed."""
        installed = set(fontManager.get_font_names())
        return next((name for name in self.fonts if name in installed), self.fonts[-1])


COLUMNS: Mapping[str, Column] = {
    "ieee1": Column(3.5, 8.0, _TIMES, "stix"),
    "ieee2": Column(7.16, 8.0, _TIMES, "stix"),
    "springer1": Column(84 * _MM, 9.0, _HELVETICA, "dejavusans"),
    "springer2": Column(174 * _MM, 9.0, _HELVETICA, "dejavusans"),
}
"""IEEE's single and double column (3.5 and 7.16 in), Springer's (84 and 174 mm)."""


def column(name: str) -> Column:
    """Return a column by name.

    Raises:
        CoopenvError: there is none of that name.
    """
    if name not in COLUMNS:
        raise CoopenvError(f"unknown width '{name}'{suggest(name, COLUMNS)}; known: {', '.join(COLUMNS)}")
    return COLUMNS[name]


def inches_of(width: str | float | None) -> float | None:
    """Return the width of a figure in inches: of a column by name, or as it is; None: a page's."""
    return column(width).inches if isinstance(width, str) else width


def style(name: str, height: float = 0.68) -> dict[str, Any]:
    """Return Matplotlib's settings for figures of one's own, to give to `plt.style.use` or `matplotlib.rc_context`.

    Args:
        name: one of `COLUMNS`.
        height: of a figure, as a share of its width.

    Raises:
        CoopenvError: there is no such column.
    """
    one = column(name)
    small = one.size * house.SMALL / house.NORMAL
    return {
        "figure.figsize": (one.inches, one.inches * height),
        "figure.constrained_layout.use": True,
        "font.family": [one.font],
        "mathtext.fontset": one.mathematics,
        "font.size": one.size,
        "axes.titlesize": one.size,
        "axes.labelsize": one.size,
        **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), small),
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), house.INK),
        "axes.prop_cycle": _cycle(),
        "axes.linewidth": 0.6,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": house.RULE,
        "grid.linewidth": 0.5,
        "lines.linewidth": 1.0,
        "legend.frameon": False,
        "savefig.dpi": 600,
        "pdf.fonttype": 42,
        "ps.fonttype": 42,
    }


def _cycle() -> Any:
    from cycler import cycler

    return cycler(color=house.VEHICLE_COLOURS)


def restyle(figure: Figure, name: str) -> Figure:
    """Set a figure that was drawn in a column's width in the column's fonts and sizes, and return it.

    Raises:
        CoopenvError: there is no such column.
    """
    one = column(name)
    scale = one.size / house.NORMAL
    for ax in figure.axes:
        for axis in _axes_of(ax):
            size: Any = axis.get_tick_params().get("labelsize", house.SMALL)
            axis.set_tick_params(labelsize=scale * size, labelfontfamily=one.font)
    ticks = {id(text) for ax in figure.axes for axis in _axes_of(ax) for text in axis.get_ticklabels(which="both")}
    if one.inches < house.NARROW:
        for line in figure.findobj(Line2D):
            line.set_markersize(_SMALLER * line.get_markersize())
    for text in figure.findobj(Text):
        if id(text) not in ticks:
            text.set_fontsize(scale * float(text.get_fontsize()))
        text.set_fontfamily(one.font)
        text.set_math_fontfamily(one.mathematics)
    return figure


def _axes_of(ax: Any) -> Iterator[Any]:
    yield from (getattr(ax, name) for name in ("xaxis", "yaxis", "zaxis") if hasattr(ax, name))


def save_figures(
    trajectory: Trajectory,
    directory: str | Path,
    observability: Observability | None = None,
    *,
    scenario: Scenario | None = None,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    file_format: str = "png",
    note: str = "",
    about: Mapping[str, object] | None = None,
    width: str | float | None = None,
    gain: bool = False,
) -> list[Path]:
    """Write the figures of `FIGURE_NAMES` into `directory`, which is made if need be, and return their paths.

    Args:
        trajectory: the record of a run.
        directory: where the files go; files of the same names are replaced.
        observability: with the default window and threshold unless given.
        scenario: of the run, for the roads and buildings under its paths.
        ends: s, when each vehicle arrived or collided and was parked, where its lines stop (None: no vehicle was).
        steady_from: s, start of the steady state that mean NEES are over (None: at 70 % of the record).
        file_format: one of `FORMATS`.
        note: in small print below each figure: what it is of.
        about: what metadata of the files say: environment, observer, seed.
        width: a column of `coopenv.viz.figures.COLUMNS`, whose fonts the figures then have, or inches (None: a page's).
        gain: whether P is a gain matrix and no covariance.

    Raises:
        OutputError: the directory cannot be made or written to.
        CoopenvError: no such format or column.
    """
    directory = Path(directory)
    inches = inches_of(width)
    drawings = _drawings(trajectory, observability, scenario, ends, steady_from, gain, inches)
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in FIGURE_NAMES:
        figure = drawings[name]()
        sign(figure, note)
        if isinstance(width, str):
            restyle(figure, width)
        paths.append(
            save(figure, directory / f"{name}.{file_format}", about=about or ({"About": note} if note else {}))
        )
    return paths


def draw_figure(
    name: str,
    trajectory: Trajectory,
    *,
    scenario: Scenario | None = None,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    width: str | float | None = None,
    gain: bool = False,
) -> Figure:
    """Return one figure of a run; arguments as for `save_figures`.

    Raises:
        CoopenvError: no figure or column of that name.
    """
    drawings = _drawings(trajectory, None, scenario, ends, steady_from, gain, inches_of(width))
    if name not in drawings:
        raise CoopenvError(f"unknown figure '{name}'{suggest(name, drawings)}; known: {', '.join(drawings)}")
    figure = drawings[name]()
    return restyle(figure, width) if isinstance(width, str) else figure


def _drawings(
    trajectory: Trajectory,
    observability: Observability | None,
    scenario: Scenario | None,
    ends: Sequence[float] | None,
    steady_from: float | None,
    gain: bool,
    width: float | None,
) -> dict[str, Callable[[], Figure]]:
    """Return how each figure is drawn, by name."""

    def seen() -> Observability:
        return analyse_observability(trajectory) if observability is None else observability

    return {
        "errors": lambda: error_figure(trajectory, ends, width),
        "trajectories_2d": lambda: trajectory_figure_2d(trajectory, ends, scenario, width),
        "trajectories_3d": lambda: trajectory_figure_3d(trajectory, ends, scenario, width),
        "topology": lambda: topology_figure(trajectory, ends, width),
        "consistency": lambda: consistency_figure(trajectory, ends, steady_from, width, gain=gain),
        "observability": lambda: observability_figure(seen(), ends, width),
    }
