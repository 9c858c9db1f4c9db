"""All figures of a run, written under stable names.

`style` gives Matplotlib's settings for your own figures, `restyle` changes a figure of this package:

    import matplotlib.pyplot as plt
    from coopenv.viz import figures

    plt.style.use(figures.style("ieee1"))
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from matplotlib.lines import Line2D
from matplotlib.text import Text

from coopenv.base.errors import check_one_of
from coopenv.base.files import writing
from coopenv.estimation import Sight
from coopenv.estimation.metrics import STEADY_SHARE, live_ticks, mean_targets_in_view, shown_note, shown_vehicles
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario import Scenario
from coopenv.viz import FIGURE_NAMES
from coopenv.viz import style as house
from coopenv.viz.error_figures import consistency_figure, error_figure, observability_figure
from coopenv.viz.style import save, sign
from coopenv.viz.trajectories import trajectory_figure_2d, trajectory_figure_3d

_HIDDEN = {"facecolor": "white"}
_LOOKS: dict[Sight, tuple[str, dict[str, Any]]] = {
    Sight.VISIBLE: ("visible", {"facecolor": house.BLUE, "edgecolor": "none"}),
    Sight.OCCLUDED_BY_BODY: ("occluded by a moving body", {**_HIDDEN, "edgecolor": house.VERMILION, "hatch": "//////"}),
    Sight.OCCLUDED_BY_BUILDING: ("occluded by a building", {**_HIDDEN, "edgecolor": house.ORANGE, "hatch": "......"}),
    Sight.OUT_OF_VIEW: ("out of view", {"facecolor": house.GREY, "edgecolor": "none"}),
    Sight.MISSED: ("a frame missed", {"color": house.INK, "linestyle": "none", "marker": "|", "markersize": 3.0}),
}
_WORDS = {
    Sight.VISIBLE: "always visible",
    Sight.OUT_OF_VIEW: "never in view",
    Sight.OCCLUDED_BY_BODY: "always behind a body",
    Sight.OCCLUDED_BY_BUILDING: "always behind a building",
    Sight.MISSED: "always missed",
}
_BAR = {Sight.OUT_OF_VIEW: 0.14}  # share of a row; 0.62 for the others
_LANE, _TITLE, _FRAME = 0.19, 0.42, 0.7  # inches
_EMPTY = 0.1  # lanes, of a vehicle without any
_LETTER = 0.068  # inches
_MOST_NAMES = 8


def topology_figure(trajectory: Trajectory, ends: Sequence[float] | None = None, width: float | None = None) -> Figure:
    """Draw, per vehicle, one lane per target against time, with a bar for the state of the line of sight.

    Targets that are the same from begin to end, such as those of a fixed topology, stand in words above the lanes.
    Blue shading: a moving target is detected, or a moving body hides a target. Grey: the vehicle has ended (at `ends`,
    s) and is parked; other vehicles may see it. `width` is in inches (None: a page's).
    """
    count = len(trajectory.vehicles)
    live = live_ticks(trajectory.t, count, ends)
    lanes = []
    for vehicle, ticks in enumerate(live):
        sight = trajectory.sight[:ticks, vehicle]
        changing = np.any(sight != sight[:1], axis=0)
        lanes.append(np.flatnonzero(np.any(sight != Sight.NOT_A_NEIGHBOUR, axis=0) & changing))
    rows = [max(_EMPTY, len(targets)) * _LANE + _TITLE for targets in lanes]
    figure, inches = house.canvas(width, _FRAME + sum(rows))
    axes = figure.subplots(count, 1, squeeze=False, height_ratios=[max(_EMPTY, len(lane)) for lane in lanes])[:, 0]
    shaded = False
    last = max((vehicle for vehicle, targets in enumerate(lanes) if len(targets)), default=-1)
    for vehicle, (ax, targets) in enumerate(zip(axes, lanes, strict=True)):
        shaded |= _draw_lanes(ax, trajectory, vehicle, targets, live[vehicle])
        house.time_axis(ax, trajectory.t, labelled=vehicle == last)
        _write_title(ax, trajectory, vehicle, targets, live[vehicle], inches)
    drawn = [trajectory.sight[:ticks, i][:, lanes[i]] for i, ticks in enumerate(live)]
    occurring = {kind for part in drawn for kind in np.unique(part)}
    handles = house.marks(
        *((kind in occurring, *mark) for kind, mark in _LOOKS.items()),
        (shaded, "moving target involved", {"facecolor": house.SHADE}),
        (live.min() < len(trajectory.t), "ended, parked", {"facecolor": house.ENDED}),
    )
    if handles:
        house.legend_above(figure, handles)
    return figure


def _draw_lanes(ax: Axes, trajectory: Trajectory, vehicle: int, targets: np.ndarray, ticks: int) -> bool:
    """Draw one vehicle's lanes; return whether a moving target is ever involved."""
    if not len(targets):
        ax.axis("off")
        return False
    names, live = house.target_labels(trajectory), np.arange(len(trajectory.t)) < ticks
    sight = np.where(live[:, None], trajectory.sight[:, vehicle], Sight.NOT_A_NEIGHBOUR)
    house.tidy(ax)
    ax.grid(False, axis="y")
    seen = house.moving_target_seen(trajectory, vehicle, ticks)
    involved = seen | np.any(sight == Sight.OCCLUDED_BY_BODY, axis=-1)
    house.shade(ax, house.runs(trajectory.t, involved, house.MERGED_GAP))
    house.shade_ended(ax, trajectory.t, ticks)
    for lane, target in enumerate(targets):
        for kind, (_, look) in _LOOKS.items():
            at = sight[:, target] == kind
            if kind == Sight.MISSED:
                ax.plot(trajectory.t[at], np.full(at.sum(), lane - 0.42), **look)
            elif at.any():
                gap = house.MERGED_GAP if kind == Sight.VISIBLE else 0.0  # a frame missed does not cut a bar
                width = _BAR.get(kind, 0.62)
                stretches = house.runs(trajectory.t, at, gap)
                ax.broken_barh(stretches, (lane - width / 2, width), linewidth=0.4, **look)
    ax.set_yticks(range(len(targets)), [names[target] for target in targets])
    ax.set_ylim(len(targets) - 0.5, -0.6)
    return bool(involved.any())


def _write_title(
    ax: Axes, trajectory: Trajectory, vehicle: int, targets: np.ndarray, ticks: int, inches: float
) -> None:
    """Write the vehicle's name, its mean number of visible targets, and the lines of sight that never change."""
    seen = mean_targets_in_view(trajectory.visible[:ticks, vehicle])
    parts = [f"{seen:.2f} targets in view on average"]
    names, first = house.target_labels(trajectory), trajectory.sight[0, vehicle]
    neighbours = np.any(trajectory.sight[:ticks, vehicle] != Sight.NOT_A_NEIGHBOUR, axis=0)
    for kind, words in _WORDS.items():
        same = [names[i] for i in np.flatnonzero(neighbours & (first == kind)) if i not in targets]
        if same:
            parts.append(f"{words}: {_listed(same)}")
    if not neighbours.any():
        parts = ["no neighbours"]
    words = f"{house.vehicle_label(trajectory.vehicles[vehicle])}:  {'; '.join(parts)}"
    room = int(0.9 * inches / _LETTER)
    ax.set_title(fill(words, room), loc="left", fontsize=house.SMALL + 0.5, pad=3.0, color=house.INK)


def _listed(names: Sequence[str]) -> str:
    """Return names with commas between, of many the first and the last."""
    if len(names) <= _MOST_NAMES:
        return ", ".join(names)
    return f"{names[0]} to {names[-1]} ({len(names)})"


_MM = 1 / 25.4
_SMALLER = 0.7  # marks in a narrow column
_TIMES = ("Times New Roman", "Nimbus Roman", "TeX Gyre Termes", "Liberation Serif", "STIXGeneral")
_HELVETICA = ("Arial", "Helvetica", "Nimbus Sans", "TeX Gyre Heros", "Liberation Sans", "DejaVu Sans")


class Column(NamedTuple):
    """Typesetting of a journal's figures of one width."""

    inches: float
    size: float
    """pt, of labels; ticks and legends are a sixth smaller."""
    fonts: tuple[str, ...]
    """Fonts by preference; Matplotlib ships the last one."""
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
    check_one_of("unknown width", name, COLUMNS)
    return COLUMNS[name]


def inches_of(width: str | float | None) -> float | None:
    """Return the width of a figure in inches: of a column by name, or as it is; None: a page's."""
    return column(width).inches if isinstance(width, str) else width


def style(name: str, height: float = 0.68) -> dict[str, Any]:
    """Return Matplotlib's settings for your own figures, to give to `plt.style.use` or `matplotlib.rc_context`.

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
        "axes.prop_cycle": cycler(color=house.VEHICLE_COLOURS),
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
    file_format: str = "png",
    note: str = "",
    about: Mapping[str, object] | None = None,
    **options: Any,
) -> list[Path]:
    """Write the figures of `FIGURE_NAMES` into `directory`, which is made if need be, and return their paths.

    Args:
        trajectory: the record of a run.
        directory: folder of the files; files of the same names are replaced.
        observability: with the default window and threshold unless given.
        file_format: one of `FORMATS`.
        note: in small print below each figure: its subject.
        about: metadata of the files: environment, observer, seed.
        options: further arguments of `draw_figure`.

    Raises:
        OutputError: the directory cannot be made or written to.
        CoopenvError: no such format or column.
    """
    directory = Path(directory)
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name in FIGURE_NAMES:
        figure = draw_figure(name, trajectory, observability, note=note, **options)
        about = about or ({"About": note} if note else {})
        paths.append(save(figure, directory / f"{name}.{file_format}", about=about))
    return paths


def draw_figure(
    name: str,
    trajectory: Trajectory,
    observability: Observability | None = None,
    *,
    scenario: Scenario | None = None,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    width: str | float | None = None,
    gain: bool = False,
    note: str = "",
) -> Figure:
    """Return one figure of a run: of a large fleet, of `shown_vehicles` alone, which it then says.

    Args:
        name: one of `FIGURE_NAMES`.
        trajectory: the record of a run.
        observability: with the default window and threshold unless given.
        scenario: of the run, for the roads and buildings under its paths.
        ends: s, when each vehicle arrived or collided and was parked, where its lines stop (None: no vehicle was).
        steady_from: s, start of the steady state that mean NEES are over (None: at 70 % of the record).
        width: a column of `coopenv.viz.figures.COLUMNS`, whose fonts the figure then has, or inches (None: a page's).
        gain: P is a gain matrix and no covariance.
        note: in small print below the figure: its subject.

    Raises:
        CoopenvError: no figure or column of that name.
    """
    inches, fleet = inches_of(width), trajectory.vehicles.tolist()
    steady_from = STEADY_SHARE * float(trajectory.t[-1]) if steady_from is None else steady_from
    shown = shown_vehicles(trajectory, steady_from, ends)
    trajectory, ends = trajectory.of_vehicles(shown), None if ends is None else [ends[i] for i in shown]
    paths = trajectory.without_targets({*fleet} - {*trajectory.vehicles.tolist()})  # its vehicles are no landmarks
    observability = observability and observability.selected(shown)
    drawings: dict[str, Callable[[], Figure]] = {
        "errors": lambda: error_figure(trajectory, ends, inches),
        "trajectories_2d": lambda: trajectory_figure_2d(paths, ends, scenario, inches),
        "trajectories_3d": lambda: trajectory_figure_3d(paths, ends, scenario, inches),
        "topology": lambda: topology_figure(trajectory, ends, inches),
        "consistency": lambda: consistency_figure(trajectory, ends, steady_from, inches, gain=gain),
        "observability": lambda: observability_figure(observability or analyse_observability(trajectory), ends, inches),
    }
    check_one_of("unknown figure", name, drawings)
    figure = drawings[name]()
    sign(figure, "\n".join(filter(None, (shown_note(len(fleet)), note))))
    return restyle(figure, width) if isinstance(width, str) else figure
