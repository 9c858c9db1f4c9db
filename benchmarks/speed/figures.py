"""Figures of a measurement: rates over worlds, costs over sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from benchmarks.speed.coopenv_cases import BATCH, SINGLE
from benchmarks.speed.growth import WORLDS, Growth
from benchmarks.speed.measure import Result
from benchmarks.speed.tables import count
from coopenv.viz import style

PEER_LOOKS = {
    "highway-env intersection": (style.PURPLE, "D"),
    "VMAS navigation": (style.VERMILION, "s"),
    "VMAS road_traffic": (style.GREEN, "^"),
    "mpe2 simple_spread": (style.ORANGE, "v"),
}
GROWTH_LOOKS = {
    "sensed": (style.BLUE, "o"),
    "three neighbours": (style.VERMILION, "s"),
    "nearby": (style.GREEN, "^"),
    "nearby, robust": (style.SKY, "D"),
}


def draw_speed(results: list[Result], path: Path) -> Path:
    """Draw agent steps and vehicle ticks per second over the number of worlds."""
    shown = [r for r in results if not r.problem]
    figure = style.new_figure(8.4, 4.3)
    left, right = figure.subplots(1, 2)
    curves = _curves(shown)
    for ax, what in ((left, "agent_steps_per_s"), (right, "vehicle_ticks_per_s")):
        for label, (points, colour, marker, dash) in curves.items():
            x = [r.case.worlds for r in points]
            y = [getattr(r, what) for r in points]
            ax.plot(
                x, y, color=colour, marker=marker, linestyle=dash, linewidth=style.LINE, markersize=4.5, label=label
            )
        _logarithmic(ax)
    style.tidy(left, x_label="worlds", y_label="agent steps per second [1/s]")
    style.tidy(right, x_label="worlds", y_label="vehicle ticks (sensor scans) per second [1/s]")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=3, fontsize=style.SMALL, frameon=False)
    figure.tight_layout(rect=(0, 0.02 + 0.04 * -(-len(labels) // 3), 1, 1))
    return style.save(figure, path)


def _logarithmic(ax: Axes) -> None:
    """Scale both axes by powers, with plain numbers on them and more of these where the range is short."""
    ax.set_xscale("log", base=2)
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    ax.yaxis.set_major_formatter(lambda value, _: count(value))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _curves(shown: list[Result]) -> dict[str, tuple[list[Result], str, str, str]]:
    """Return points, colour, marker and line style per label."""
    looks = {
        (BATCH, "float32"): (style.BLUE, "o"),
        (BATCH, "float64"): (style.SKY, "o"),
        (SINGLE, "float32"): (style.INK, "*"),
        (SINGLE, "float64"): (style.GREY, "*"),
    }
    curves: dict[str, tuple[list[Result], str, str, str]] = {}
    for result in shown:
        case = result.case
        colour, marker = looks.get((case.name, case.dtype)) or PEER_LOOKS.get(case.name) or ("", "")
        if not colour:
            continue
        own = (case.name, case.dtype) in looks
        threads = f", {case.threads} thread{'s' if case.threads > 1 else ''}" if own else ""
        label = f"coopenv {case.name}, {case.dtype}{threads}" if own else case.name
        points = curves.setdefault(label, ([], colour, marker, "--" if case.threads > 1 else "-"))[0]
        points.append(result)
    return curves


def draw_growth(found: list[Growth], path: Path) -> Path:
    """Draw the CPU time of a step over vehicles, landmarks and worlds, with the fits to the larger half."""
    quantities = list(dict.fromkeys(g.sweep.quantity for g in found))
    figure = style.new_figure(3.0 * len(quantities) + 0.4, 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(quantities)))
    for ax, quantity in zip(axes, quantities, strict=True):
        for g in (g for g in found if g.sweep.quantity == quantity):
            _growth_curve(ax, g)
        _logarithmic(ax)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.45)  # room for the legend
        ax.legend(fontsize=style.SMALL, frameon=False, loc="upper left")
        held = "" if quantity == "worlds" else f" ({WORLDS} worlds)"
        style.tidy(ax, x_label=quantity, y_label=f"CPU time of one step{held} [ms]")
    figure.tight_layout()
    return style.save(figure, path)


def _growth_curve(ax: Axes, g: Growth) -> None:
    colour, marker = GROWTH_LOOKS[g.sweep.kind]
    kind = f"{g.sweep.kind}, one world" if g.sweep.nearby else g.sweep.kind
    label = f"{kind}: $n^{{{g.large.exponent:.2f}}}$"
    ax.plot(
        g.sizes, 1e3 * np.array(g.costs), color=colour, marker=marker, markersize=4, linewidth=style.LINE, label=label
    )
    ends = np.array([g.sizes[min(len(g.sizes) // 2, len(g.sizes) - 2)], g.sizes[-1]], dtype=float)
    ax.plot(ends, 1e3 * g.large.factor * ends**g.large.exponent, color=style.INK, linestyle=":", linewidth=style.LINE)
