"""Errors, consistency and observability over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from coopenv.estimation.metrics import (
    CONVERGED,
    STEADY_SHARE,
    live_ticks,
    mean_bounds,
    observability_of,
    settling_times,
    steady_mean,
)
from coopenv.estimation.observability import Observability
from coopenv.estimation.poses import error_rotation, position_covariance, roll_pitch_yaw_deg
from coopenv.estimation.trajectory import Trajectory
from coopenv.viz import style

_ROW, _NARROW_ROW, _FRAME = 1.35, 0.95, 0.95  # inches
_LAST: dict[str, Any] = {"color": style.INK, "linewidth": 0.8, "linestyle": (0, (4, 2))}
_TOLERATED: dict[str, Any] = {"color": style.GREY, "linewidth": 0.9, "linestyle": (0, (1, 1.5))}
_LINEAR: dict[str, Any] = {"facecolor": "#FBF3DC", "edgecolor": "none", "zorder": 0}
_PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 1}
_LATE = 0.7  # share of the record after which errors are small, and drawn linearly
_LEAST_LINEAR = 1e-3  # m or deg
_MOST_DECADES = 2  # that are labelled on each side of zero
_ALWAYS = 0.95  # share of the record: a condition that holds for longer is not shaded
_USUAL = 0.9  # share of the last errors that are drawn linearly
_DOT = 4.0  # pt


def error_figure(trajectory: Trajectory, ends: Sequence[float] | None = None, width: float | None = None) -> Figure:
    """Draw position (map frame, m) and orientation errors (roll, pitch, yaw of Rtilde, deg) against time.

    Ordinates are linear about zero and logarithmic beyond, the same for all vehicles, so that the first errors and the
    last can be read alike. Lines are medians over short stretches, bands their range. Dots: the errors at t = 0, before
    the first correction. Blue shading: the vehicle detects a moving target. Dashed line: from there on the errors stay
    below the tolerance. Grey: the vehicle has ended (at `ends`, s) and is parked. `width`: inches (None: a page's).
    """
    count = len(trajectory.vehicles)
    narrow = width is not None and width < style.NARROW
    figure, inches = style.canvas(width, _FRAME + (_NARROW_ROW if narrow else _ROW) * count)
    axes = figure.subplots(count, 2, squeeze=False)
    converged, live = settling_times(trajectory, ends), live_ticks(trajectory.t, count, ends)
    seen = [style.moving_target_seen(trajectory, vehicle, ticks) for vehicle, ticks in enumerate(live)]
    events = [
        mask if mask[:ticks].mean() < _ALWAYS else np.zeros_like(mask) for mask, ticks in zip(seen, live, strict=True)
    ]
    bins, tolerances = style.bins_of(inches / 2), (CONVERGED.position_m, CONVERGED.orientation_deg)
    for components, tolerance, column in zip(_errors(trajectory, live), tolerances, axes.T, strict=True):
        for vehicle, (ax, ticks) in enumerate(zip(column, live, strict=True)):
            style.shade(ax, style.runs(trajectory.t, events[vehicle], style.MERGED_GAP))
            _draw(ax, trajectory.t[:ticks], components[vehicle], tolerance, bins)
            if np.isfinite(converged[vehicle]):
                ax.axvline(converged[vehicle], **_LAST)
        _share_scale(column, components, tolerance)
    error = "" if narrow else " error"
    _finish(axes, trajectory, live, (f"position{error} [m]", f"orientation{error} [deg]"))
    for ax, last in zip(axes[:, 0], converged, strict=True):
        when = f"last above {CONVERGED.position_m:g} m or {CONVERGED.orientation_deg:g} deg: {last:.1f} s"
        when = "above to the end" if np.isnan(last) else f"last above: {last:.1f} s" if narrow else when
        style.note(ax, 0.985, 0.95, when, ha="right", va="top", bbox=_PAPER)
    dot = {"color": style.INK, "linestyle": "none", "marker": "o", "markersize": _DOT}
    axis_names = zip(style.AXES_COLOURS, ("x, roll", "y, pitch", "z, yaw"), strict=True)
    marks = style.marks(
        *((True, name, {"color": colour, "linewidth": style.LINE}) for colour, name in axis_names),
        (True, "at t = 0", dot),
        (True, f"± {CONVERGED.text}", _TOLERATED),
        (True, "linear; log beyond", {"facecolor": _LINEAR["facecolor"], "edgecolor": style.RULE}),
        (np.isfinite(converged).any(), "last above either", _LAST),
        (any(map(np.any, events)), "moving target detected", {"facecolor": style.SHADE}),
        (live.min() < len(trajectory.t), "ended, parked", {"facecolor": style.ENDED}),
    )
    style.legend_above(figure, marks)
    return figure


def _finish(axes: np.ndarray, trajectory: Trajectory, live: np.ndarray, titles: Sequence[str]) -> None:
    """Finish panels (vehicle, quantity) on which everything has been drawn; `live` ticks of a vehicle count."""
    for vehicle, row in enumerate(axes):
        for ax in row:
            style.tidy(ax)
            style.shade_ended(ax, trajectory.t, live[vehicle])
            style.time_axis(ax, trajectory.t, labelled=vehicle == len(axes) - 1)
        name = style.vehicle_label(trajectory.vehicles[vehicle])
        row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=style.NORMAL + 2, color=style.INK)
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, **style.TEXT)


def _errors(trajectory: Trajectory, live: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return errors of position, m, and orientation, deg: per vehicle (k, 3) while it is under way."""
    positions, angles = [], []
    for vehicle, ticks in enumerate(live):
        part = slice(ticks), vehicle
        with np.errstate(invalid="ignore", over="ignore"):  # of an observer that has diverged
            tilde = error_rotation(trajectory.rotation[part], trajectory.rotation_estimate[part])
            error = np.asarray(trajectory.position[part], float) - trajectory.position_estimate[part]
        positions.append(style.drawable(error))
        angles.append(unwrapped(style.drawable(roll_pitch_yaw_deg(tilde))))
    return positions, angles


def unwrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles (K, 3), deg, without jumps by whole turns; in the end they lie within half a turn of zero.

    NaN stays NaN.
    """
    result = np.array(angles, float)
    for angle in result.T:
        known = np.isfinite(angle)
        if known.any():
            smooth = np.unwrap(angle[known], period=360.0)
            late = np.median(smooth[int(_LATE * len(smooth)) :])
            angle[known] = smooth - 360.0 * np.round(late / 360.0)
    return result


def _draw(ax: Axes, t: np.ndarray, components: np.ndarray, tolerance: float, bins: int) -> None:
    ax.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
    for level in (-tolerance, tolerance):
        ax.axhline(level, **_TOLERATED)
    for component, colour in zip(components.T, style.AXES_COLOURS, strict=True):
        first = 1 if len(t) > 1 else 0  # the error before the first correction is a dot
        style.draw_band(ax, t[first:], component[first:], bins, color=colour, linewidth=style.LINE)
        ax.plot(t[:1], component[:1], "o", color=colour, markersize=_DOT, clip_on=False, zorder=4)


def _share_scale(column: Sequence[Axes], components: Sequence[np.ndarray], tolerance: float) -> None:
    """Give panels the same ordinate: linear up to the size of the last errors, logarithmic beyond."""
    late = np.concatenate([part[int(_LATE * len(part)) :].ravel() for part in components])
    whole = np.concatenate([part.ravel() for part in components])
    late, whole = np.abs(late[np.isfinite(late)]), np.abs(whole[np.isfinite(whole)])
    usual = float(np.quantile(late, _USUAL)) if len(late) else 0.0
    largest = float(whole.max(initial=tolerance))
    linear = float(np.clip(10 ** np.ceil(np.log10(max(usual, 1e-12))), _LEAST_LINEAR, tolerance))
    decades = linear * 10.0 ** np.arange(0, np.floor(np.log10(largest / linear) + 1e-9) + 1)
    decades = decades[:: -(-len(decades) // _MOST_DECADES)]
    for ax in column:
        ax.set_yscale("symlog", linthresh=linear, linscale=1.0)
        ax.axhspan(-linear, linear, **_LINEAR)
        ax.set_ylim(-1.6 * largest, 1.6 * largest)
        ax.set_yticks([*-decades[::-1], 0.0, *decades])
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "\N{MINUS SIGN}")))


_NEES_ROW, _NEES_NARROW_ROW, _NEES_FRAME = 1.3, 0.95, 1.2  # inches
_EXPECTED: dict[str, Any] = {"color": style.GREY, "linewidth": 0.8, "linestyle": (0, (4, 2))}
_STEADY: dict[str, Any] = {"color": style.INK, "linewidth": 0.7, "linestyle": (0, (1, 1.5))}
_CLAIMED: dict[str, Any] = {"color": style.VERMILION, "linestyle": (0, (4, 1.5)), "linewidth": 1.4}
_ERROR: dict[str, Any] = {"color": style.INK, "linestyle": "-", "linewidth": 0.8}
_SHORT = 9.0  # inches: in narrower figures panels have no room for sentences
_TITLES = ("NEES, log", "position [m], log", "orientation [deg], log")
_NARROW_TITLES = ("NEES, log", "[m], log", "[deg], log")
_ROOM = 0.3  # of the height, for words above the curves
CONSISTENT = (
    "The NEES of a consistent observer lies in the band 95 % of the time; "
    "above the band, the observer is overconfident."
)
GAIN = "The P of this observer is the gain matrix of its Riccati equation, not a covariance: its NEES is meaningless."


def consistency_figure(
    trajectory: Trajectory,
    ends: Sequence[float] | None = None,
    steady_from: float | None = None,
    width: float | None = None,
    *,
    gain: bool = False,
) -> Figure:
    """Draw, per vehicle, NEES, and both errors beside the standard deviations that the observer claims.

    The bounds hold at each instant over many runs; the ticks of one run are correlated, so the share of ticks
    inside is a hint, not a test. Ordinates are the same for all vehicles.

    Args:
        trajectory: the record of a run.
        ends: s, when each vehicle was parked, after which no sample counts.
        steady_from: s; the mean NEES and the share inside are over the ticks after it (None: `STEADY_SHARE` of
            the record).
        width: inches (None: a page's).
        gain: P is the gain matrix of an observer that states no covariance; the figure notes it.
    """
    if steady_from is None:
        steady_from = STEADY_SHARE * float(trajectory.t[-1])
    count = len(trajectory.vehicles)
    narrow, short = (width is not None and width < limit for limit in (style.NARROW, _SHORT))
    figure, _ = style.canvas(width, _NEES_FRAME + (_NEES_NARROW_ROW if narrow else _NEES_ROW) * count)
    axes = figure.subplots(count, 3, squeeze=False)
    P, dof = np.asarray(trajectory.covariance, float), trajectory.nees_dof
    with np.errstate(over="ignore", invalid="ignore"):  # of an observer that has diverged
        of_position = position_covariance(trajectory.rotation_estimate, trajectory.position_estimate, P)
        stds = [np.sqrt(np.trace(block, axis1=-2, axis2=-1)) for block in (of_position, P[..., :3, :3])]
    live = live_ticks(trajectory.t, count, ends)
    for vehicle, (left, middle, right) in enumerate(axes):
        t, part = trajectory.t[: live[vehicle]], (slice(live[vehicle]), vehicle)
        _draw_nees(left, t, trajectory.nees[part], dof, steady_from, short)
        _draw_spread(middle, t, trajectory.position_error[part], stds[0][part])
        _draw_spread(right, t, trajectory.orientation_error[part], np.degrees(stds[1][part]))
    _finish(axes, trajectory, live, _NARROW_TITLES if narrow else _TITLES)
    for column, room in zip(axes.T, (_ROOM, 0.0, 0.0), strict=True):
        style.share_decades(column, room)
    style.explain(figure, GAIN if gain else CONSISTENT)
    marks = style.marks(
        (True, f"95 % of $\\chi^2_{dof}$", {"facecolor": style.SHADE}),
        (True, "expected", _EXPECTED),
        (trajectory.t[0] < steady_from < trajectory.t[-1], "steady state", _STEADY),
        (True, "error", _ERROR),
        (True, "claimed std. deviation", _CLAIMED),
        (live.min() < len(trajectory.t), "ended, parked", {"facecolor": style.ENDED}),
    )
    style.legend_above(figure, marks)
    return figure


def nees_bounds(dof: int) -> tuple[float, float]:
    """Return between which 95 % of the NEES of a consistent observer lie, at one instant over many runs."""
    low, high = mean_bounds(dof)
    return dof * low, dof * high


def _draw_nees(ax: Axes, t: np.ndarray, nees: np.ndarray, dof: int, steady_from: float, short: bool) -> None:
    ax.axhspan(*nees_bounds(dof), color=style.SHADE, zorder=0)
    ax.axhline(dof, **_EXPECTED)
    ax.set_yscale("log")
    shown = style.drawable(nees, positive=True)
    if np.isnan(shown).all():
        reason = "no covariance declared" if np.isnan(nees).all() else "none to draw"
        style.note(ax, 0.5, 0.5, reason, ha="center", color=style.NOTE)
        return
    keep = style.thinned(len(t))
    ax.plot(t[keep], shown[keep], color=style.INK, linewidth=0.7)
    words = _verdict(t, nees, dof, steady_from, short)
    style.note(ax, 0.985, 0.95, words, ha="right", va="top", path_effects=style.HALO)
    if t[0] < steady_from < t[-1]:
        ax.axvline(steady_from, **_STEADY)


def _verdict(t: np.ndarray, nees: np.ndarray, dof: int, steady_from: float, short: bool) -> str:
    """Return the mean NEES that the table of the run has, too."""
    steady = nees[t > steady_from]
    if not len(steady):
        return "ended before" if short else f"ended before the steady state ({steady_from:.4g} s)"
    low, high = nees_bounds(dof)
    inside = np.mean((steady >= low) & (steady <= high))
    mean = float(steady_mean(t, nees, steady_from))
    if short:
        return f"mean {mean:.3g}"
    return f"after {steady_from:.4g} s: mean {mean:.3g}, {100 * inside:.0f} % of ticks inside"


def _draw_spread(ax: Axes, t: np.ndarray, error: np.ndarray, spread: np.ndarray) -> None:
    ax.set_yscale("log")
    keep = style.thinned(len(t))
    for values, look in ((spread, _CLAIMED), (error, _ERROR)):
        shown = style.drawable(values, positive=True)
        if not np.isnan(shown).all():
            ax.plot(t[keep], shown[keep], **look)


_VERDICTS: dict[bool, tuple[str, dict[str, Any]]] = {
    True: ("observable", {"facecolor": style.GREEN, "edgecolor": "none"}),
    False: ("not observable", {"facecolor": "white", "edgecolor": style.VERMILION, "hatch": "//////"}),
}
_FLOOR = 1e-8  # smaller eigenvalues are drawn here: they are zero but for rounding
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)), (0, (1, 0.8)))
_THRESHOLD: dict[str, Any] = {"color": style.INK, "linewidth": 0.9, "linestyle": _DASHES[1]}
_GRAMIAN_FRAME, _NARROW_FRAME, _LANE = 3.6, 2.6, 0.24  # inches
MEANING = (
    "Observable: the bearings of a window, together with odometry, determine the pose near the truth. "
    "It does not promise that an observer gets there from any start."
)


def observability_figure(
    observability: Observability, ends: Sequence[float] | None = None, width: float | None = None
) -> Figure:
    """Draw the eigenvalue that the verdict rests on, and the verdict of every vehicle.

    Windows that reach beyond a vehicle's end (s) are left out. `width` is in inches (None: a page's).
    """
    count = len(observability.vehicles)
    cut = [observability_of(observability, i, np.nan if ends is None else ends[i]) for i in range(count)]
    frame = _NARROW_FRAME if width is not None and width < style.NARROW else _GRAMIAN_FRAME
    figure, _ = style.canvas(width, frame + _LANE * count)
    local, verdict = figure.subplots(2, 1, height_ratios=(2.0, max(0.3, _LANE * count)))
    names = [style.vehicle_label(name) for name in observability.vehicles]
    looks: list[dict[str, Any]] = [  # with different dashes, because lines may coincide
        {"linewidth": style.LINE, "color": style.vehicle_colour(i), "linestyle": _DASHES[i % len(_DASHES)]}
        for i in range(count)
    ]
    style.tidy(local)
    local.set_yscale("log")
    for part, look in zip(cut, looks, strict=True):
        if len(part.t):
            keep = style.thinned(len(part.t))
            local.plot(part.t[keep], np.maximum(part.local_eigenvalue[keep, 0], _FLOOR), **look)
    local.axhline(observability.threshold, **_THRESHOLD)
    window = f"smallest eigenvalue of the\nGramian over {observability.window:.3g} s, scaled [-], log"
    local.set_ylabel(window, **style.TEXT)
    style.show_decades(local)
    occurring = _draw_verdict(verdict, cut, names)
    for ax in (local, verdict):
        if len(observability.t):
            span = np.array([observability.t[0], observability.t[-1] + observability.window])
            style.time_axis(ax, span, labelled=ax is verdict)
    low = any((part.local_eigenvalue < _FLOOR).any() for part in cut)
    style.explain(figure, MEANING + (f" Smaller eigenvalues are drawn at {_FLOOR:g}." if low else ""))
    marks = style.marks(
        *((True, name, look) for name, look in zip(names, looks, strict=True)),
        (True, "threshold", _THRESHOLD),
        *((observable in occurring, *mark) for observable, mark in _VERDICTS.items()),
    )
    style.legend_above(figure, marks)
    return figure


def _draw_verdict(ax: Axes, cut: list[Observability], names: Sequence[str]) -> set[bool]:
    """Draw the verdict of every vehicle, and return the verdicts that occur."""
    style.tidy(ax)
    ax.grid(False, axis="y")
    occurring = set()
    for vehicle, part in enumerate(cut):
        for observable, (_, look) in _VERDICTS.items():
            stretches = [(s, e - s) for s, e, verdict in part.intervals(0) if verdict == observable]
            if stretches:
                occurring.add(observable)
                ax.broken_barh(stretches, (vehicle - 0.32, 0.64), linewidth=0.4, **look)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    return occurring
