"""The evolution of the error states, one row per vehicle, as the paper shows them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullLocator

from coopenv.estimation.metrics import CONVERGED, error_rotation, live_ticks, roll_pitch_yaw_deg, settling_times
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style

_ROW, _NARROW_ROW, _FRAME = 1.35, 0.95, 0.95  # inches
_DASHED, _DOTTED = (0, (4, 2)), (0, (1, 1.5))
_LATE = 0.7  # share of the record after which errors are small, and drawn linearly
_LEAST_LINEAR = 1e-3  # m or deg
_MOST_DECADES = 2  # that are labelled on each side of zero
_ALWAYS = 0.95  # share of the record: what holds for longer is no event to shade
_USUAL = 0.9  # share of the last errors that are drawn linearly
_DOT = 4.0  # pt


class _Quantity(NamedTuple):
    """What one column shows."""

    components: list[np.ndarray]  # per vehicle (k, 3), m or deg
    title: str
    tolerance: float  # m or deg, of settling
    names: tuple[str, str, str]


def error_figure(trajectory: Trajectory, ends: Sequence[float] | None = None, width: float | None = None) -> Figure:
    """Draw position (map frame, m) and orientation errors (roll, pitch, yaw of Rtilde, deg) against time.

    Ordinates are linear about zero and logarithmic beyond, the same for all vehicles, so that the first errors and the
    last can be read alike. Lines are medians over short stretches, bands their range. Dots: the errors at t = 0, before
    the first correction. Blue shading: the vehicle detects a moving target. Dashed line: from there on the errors stay
    below the tolerance. Grey: the vehicle has ended (at `ends`, s) and is parked. `width`: inches (None: a page's).
    """
    count = len(trajectory.vehicles)
    narrow = width is not None and width < style.NARROW
    figure, inches = style.canvas(width, _FRAME + (_NARROW_ROW if narrow else _ROW) * count, "")
    axes = figure.subplots(count, 2, squeeze=False)
    converged, live = settling_times(trajectory, ends), live_ticks(trajectory.t, count, ends)
    seen = [style.moving_target_seen(trajectory, vehicle, ticks) for vehicle, ticks in enumerate(live)]
    events = [
        mask if mask[:ticks].mean() < _ALWAYS else np.zeros_like(mask) for mask, ticks in zip(seen, live, strict=True)
    ]
    for quantity, column in zip(_quantities(trajectory, live), axes.T, strict=True):
        for vehicle, (ax, ticks) in enumerate(zip(column, live, strict=True)):
            style.tidy(ax)
            style.shade(ax, style.runs(trajectory.t, events[vehicle], style.MERGED_GAP))
            style.shade_ended(ax, trajectory.t, ticks)
            _draw(ax, trajectory.t[:ticks], quantity, vehicle, style.bins_of(inches / 2))
            if np.isfinite(converged[vehicle]):
                ax.axvline(converged[vehicle], color=style.INK, linewidth=0.8, linestyle=_DASHED)
            style.time_axis(ax, trajectory.t, labelled=vehicle == count - 1)
        _share_scale(column, quantity)
        column[0].set_title(
            quantity.title.replace(" error", "" if narrow else " error"), fontsize=style.NORMAL, color=style.INK
        )
    for vehicle, ax in enumerate(axes[:, 0]):
        name, last = style.vehicle_label(trajectory.vehicles[vehicle]), converged[vehicle]
        ax.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=style.NORMAL + 2, color=style.INK)
        when = f"last above {CONVERGED.position_m:g} m or {CONVERGED.orientation_deg:g} deg: {last:.1f} s"
        when = "above to the end" if np.isnan(last) else f"last above: {last:.1f} s" if narrow else when
        style.note(ax, 0.985, 0.95, when, ha="right", va="top", path_effects=style.HALO)
    style.legend_above(figure, _marks(converged, any(map(np.any, events)), live.min() < len(trajectory.t)))
    return figure


def _quantities(trajectory: Trajectory, live: np.ndarray) -> tuple[_Quantity, _Quantity]:
    positions, angles = [], []
    for vehicle, ticks in enumerate(live):
        part = slice(ticks), vehicle
        with np.errstate(invalid="ignore", over="ignore"):  # of an observer that has diverged
            tilde = error_rotation(trajectory.rotation[part], trajectory.rotation_estimate[part])
            error = np.asarray(trajectory.position[part], float) - trajectory.position_estimate[part]
        positions.append(style.drawable(error))
        angles.append(unwrapped(style.drawable(roll_pitch_yaw_deg(tilde))))
    return (
        _Quantity(positions, "position error [m]", CONVERGED.position_m, ("x", "y", "z")),
        _Quantity(angles, "orientation error [deg]", CONVERGED.orientation_deg, ("roll", "pitch", "yaw")),
    )


def unwrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles (K, 3), deg, without jumps by whole turns; in the end they lie within half a turn of zero.

    What is NaN stays so, and is passed over.
    """
    result = np.array(angles, float)
    for angle in result.T:
        known = np.isfinite(angle)
        if known.any():
            smooth = np.unwrap(angle[known], period=360.0)
            late = np.median(smooth[int(_LATE * len(smooth)) :])
            angle[known] = smooth - 360.0 * np.round(late / 360.0)
    return result


def _draw(ax: Axes, t: np.ndarray, quantity: _Quantity, vehicle: int, bins: int) -> None:
    ax.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
    for level in (-quantity.tolerance, quantity.tolerance):
        ax.axhline(level, color=style.GREY, linewidth=0.9, linestyle=_DOTTED)
    for component, colour in zip(quantity.components[vehicle].T, style.AXES_COLOURS, strict=True):
        first = 1 if len(t) > 1 else 0  # what was before the first correction is a dot
        style.draw_band(ax, t[first:], component[first:], bins, color=colour, linewidth=style.LINE)
        ax.plot(t[:1], component[:1], "o", color=colour, markersize=_DOT, clip_on=False, zorder=4)


def _share_scale(column: Sequence[Axes], quantity: _Quantity) -> None:
    """Give panels the same ordinate: linear up to the size of the last errors, logarithmic beyond."""
    late = np.concatenate([part[int(_LATE * len(part)) :].ravel() for part in quantity.components])
    whole = np.concatenate([part.ravel() for part in quantity.components])
    late, whole = np.abs(late[np.isfinite(late)]), np.abs(whole[np.isfinite(whole)])
    usual = float(np.quantile(late, _USUAL)) if len(late) else 0.0
    largest = float(whole.max(initial=quantity.tolerance))
    linear = float(np.clip(10 ** np.ceil(np.log10(max(usual, 1e-12))), _LEAST_LINEAR, quantity.tolerance))
    decades = linear * 10.0 ** np.arange(0, np.floor(np.log10(largest / linear) + 1e-9) + 1)
    decades = decades[:: -(-len(decades) // _MOST_DECADES)]
    for ax in column:
        ax.set_yscale("symlog", linthresh=linear, linscale=1.0)
        ax.set_ylim(-1.6 * largest, 1.6 * largest)
        ax.set_yticks([*-decades[::-1], 0.0, *decades])
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "\N{MINUS SIGN}")))


def _marks(converged: np.ndarray, shaded: bool, ended: bool) -> list[Line2D | Patch]:
    """Return what the legend explains of all that is in the figure."""
    ink = style.INK
    lines = [
        Line2D([], [], color=colour, linewidth=style.LINE, label=f"{first}, {second}")
        for first, second, colour in zip("xyz", ("roll", "pitch", "yaw"), style.AXES_COLOURS, strict=True)
    ]
    marks: list[tuple[bool, Line2D | Patch]] = [
        (True, Line2D([], [], color=ink, linestyle="none", marker="o", markersize=_DOT, label="at t = 0")),
        (True, Line2D([], [], color=style.GREY, linestyle=_DOTTED, linewidth=0.9, label=f"± {CONVERGED.text}")),
        (
            bool(np.isfinite(converged).any()),
            Line2D([], [], color=ink, linestyle=_DASHED, linewidth=0.8, label="last above either"),
        ),
        (shaded, Patch(facecolor=style.SHADE, label="moving target detected")),
        (ended, Patch(facecolor=style.ENDED, label="ended, parked")),
    ]
    return [*lines, *(mark for occurs, mark in marks if occurs)]
