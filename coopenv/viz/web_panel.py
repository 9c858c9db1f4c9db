"""The panel beside the live scene: switches, numbers, plots and the legend."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from coopenv.base.format import fixed
from coopenv.episode import Frame, Origin, semi_axes
from coopenv.estimation import Sight
from coopenv.estimation.poses import error_dof
from coopenv.viz.error_figures import nees_bounds
from coopenv.viz.meshes import Look
from coopenv.viz.perspective import camera_image
from coopenv.viz.stage import Stage, vehicle_mark
from coopenv.viz.style import BLUE, DARK_BLUE, GREY, INK, VEHICLE_COLOURS, VERMILION, vehicle_colour
from coopenv.viz.topview_ground import TRAFFIC

LONGEST = 600
"""Frames in a plot."""
_LEAST = 1e-4  # on a logarithmic axis
_MOST_TERMS = 6
UNKNOWN_LEVEL = 100.0
"""m, at which an unknown protection level is plotted."""
_DASHES = {"3σ": [5, 4], "from": [5, 4], "to": [5, 4], "level": [2, 3]}
_LOOK: dict[str, Any] = {
    "legend": {"show": False},
    "height": 170,
    "axes": ({"size": 28}, {"size": 52}),
    "padding": (10, 14, 0, 0),
}


class Plots:
    """Charts in viser's panel."""

    def __init__(self, gui: Any, source: Origin) -> None:
        """Add them, empty and hidden."""
        named = list(zip(source.terms, VEHICLE_COLOURS[:_MOST_TERMS], strict=False))
        self._terms = len(named)
        title = f"Position error [m]; dashed: {'3σ' if source.honest else 'P, a gain'}; dotted: protection level"
        self._error = _plot(gui, title, ("error", BLUE), ("3σ", GREY), ("level", VERMILION))
        title = "NEES; dashed: 95 % if consistent"
        self._nees = _plot(gui, title, ("NEES", BLUE), ("from", GREY), ("to", GREY))
        self._parts = [self._error, self._nees]
        if named:
            self._reward = _plot(gui, "Reward terms", *named, log=False)
            words = " &nbsp; ".join(f"{swatch(colour)} {escape(name)}" for name, colour in named)
            legend = gui.add_html(f'<div style="font-size:12px;padding:0 14px">{words}</div>')
            self._parts += [self._reward, legend]
        self.set_visible(False)

    def set_visible(self, visible: bool) -> None:
        """Show or hide them."""
        for part in self._parts:
            part.visible = visible

    def show(self, frames: Sequence[Frame], vehicle: int, rate: float) -> None:
        """Show a vehicle in some frames; `rate` is in camera ticks per second."""
        if len(frames) < 2:
            return
        time = np.array([frame.tick / rate for frame in frames])
        sigma = semi_axes(np.array([frame.position_covariance[vehicle, :2, :2] for frame in frames]))[0][:, -1]
        error, nees = (
            np.array([getattr(frame, name)[vehicle] for frame in frames]) for name in ("position_error", "nees")
        )
        level = np.array([frame.protection_level[vehicle, 0] for frame in frames])
        # Observers that state no level have a curve as well: it lies on that of 3 sigma.
        level = np.minimum(level, UNKNOWN_LEVEL) if np.isfinite(level).any() else sigma
        self._error.data = (time, *map(_positive, (error, sigma, level)))
        truth, estimate = (
            [np.array([getattr(frame, name)[vehicle] for frame in frames]) for name in names]
            for names in (("rotation", "position"), ("rotation_estimate", "position_estimate"))
        )
        bounds = nees_bounds(error_dof(*truth, *estimate))
        self._nees.data = (time, _positive(nees), *(np.full(len(time), bound) for bound in bounds))
        if self._terms:
            terms = np.nan_to_num([frame.reward_terms[vehicle, : self._terms] for frame in frames])
            self._reward.data = (time, *np.ascontiguousarray(terms.T))


def _plot(gui: Any, title: str, *named: tuple[str, str], log: bool = True) -> Any:
    """Add an empty chart of curves, given by label and colour."""
    rows: list[dict[str, Any]] = [{"label": "t [s]"}]
    for label, colour in named:
        dashes = {"dash": _DASHES[label]} if label in _DASHES else {}
        rows.append({"label": label, "stroke": colour, "width": 2, "points": {"show": False}, **dashes})
    scales: dict[str, Any] = {"x": {"time": False, "auto": True}}
    if log:
        scales["y"] = {"distr": 3, "log": 10, "auto": True}
    data = (np.array([0.0, 1.0]), *(np.full(2, float(log)) for _ in named))
    return gui.add_uplot(data, tuple(rows), title=title, scales=scales, **_LOOK)


def _positive(values: np.ndarray) -> np.ndarray:
    """Return values for a logarithmic axis; a value that is not finite is replaced by the last finite one."""
    good = np.isfinite(values)
    last = np.maximum.accumulate(np.where(good, np.arange(len(values)), 0))
    filled = values[last]
    return np.asarray(np.clip(np.where(np.isfinite(filled), filled, 1.0), _LEAST, 1e6))


SPEEDS = {text: float(text) for text in ("0.1", "0.25", "0.5", "1", "2", "4", "8")}
MAGNIFICATIONS = {text: float(text) for text in ("1", "10", "100")}
_CELL = "padding:2px;text-align:right"
NONE_PICKED = "none"
_PICK = "*Pick a vehicle above, or click on one in the scene.*"
NO_FAULT = "none"
TIME_EVERY, TEXTS_EVERY, PLOTS_EVERY = 0.1, 0.25, 0.5
"""Periods (s of real time) of the slider, of tables, and of images and plots."""


@dataclass
class Abilities:
    """Controls that a source supports."""

    pace: bool = True
    """Pause, step, speed, and back to earlier frames; not of real cars."""
    observers: Sequence[str] = ()
    """Observers to choose from; the first one runs."""
    faults: Sequence[str] = ()
    """Faults that can be switched on."""


_SWITCHES = {
    "ellipsoids": "Ellipsoids",
    "estimates": "Estimates",
    "sight": "Lines of sight",
    "views": "Fields of view",
    "messages": "V2X messages",
    "levels": "Protection levels of all",
    "trails": "Trails",
    "names": "Names",
    "alone": "Lines of the picked vehicle alone",
    "follow": "Go along with the picked vehicle",
}
"""Label of each choice of a `Look`."""


class Panel:
    """viser's panel; `wishes` has the latest value of each thing that the user asked for, for the thread that shows."""

    def __init__(self, gui: Any, stage: Stage, source: Origin, look: Look, abilities: Abilities, length: float) -> None:
        """Add everything; `length` is that of the episode, s."""
        self.wishes: dict[str, Any] = {}
        self._gui, self._stage, self._source, self._look = gui, stage, source, look
        self._time_at = self._texts_at = self._plots_at = -np.inf
        self._playing: Any = None
        self._time: Any = None
        gui.set_panel_label("coopenv controls")
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        self._head = gui.add_markdown("")
        self._status = gui.add_markdown("", visible=False)
        if abilities.pace:
            self._add_playback(length)
        vehicles = {NONE_PICKED: None} | {vehicle_mark(i): i for i in range(stage.vehicles)}
        self._vehicles = self._choice("Vehicle", vehicles, "Its camera, its plots; the view goes along.")
        if abilities.observers:
            hint = "The episode runs again from its start to this moment, under this observer."
            self._choice("Observer", {name: name for name in abilities.observers}, hint)
        if abilities.faults:
            faults = {name: name for name in (NO_FAULT, *abilities.faults)}
            self._choice("Fault", faults, "What goes wrong from this moment on.")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Errors"):
            self._table = gui.add_html("")
        with tabs.add_tab("Vehicle"):
            self._vehicle_words = gui.add_markdown(_PICK)
            self._image = gui.add_image(np.full((2, 3, 3), 255, np.uint8), visible=False)
            self._plots = Plots(gui, source)
        with tabs.add_tab("Show"):
            magnified = gui.add_button_group("Ellipsoids x", tuple(MAGNIFICATIONS))
            initial = f"{look.magnification:g}"
            magnified.value = initial if initial in MAGNIFICATIONS else "1"
            self._on(magnified.on_click, "magnification", MAGNIFICATIONS)
            for name, label in _SWITCHES.items():
                self._on(gui.add_checkbox(label, getattr(look, name)).on_update, f"show {name}")
            self._legend = gui.add_html("")
        self.set_source(source)

    def _add_playback(self, length: float) -> None:
        self._playing = self._gui.add_button("Pause")
        self._on(self._playing.on_click, "play")
        group = self._gui.add_button_group("Go", ("Step", "Restart"))
        self._on(group.on_click, "go", {"Step": "step", "Restart": "restart"})
        self._choice("Speed", SPEEDS, "Times real time.", initial="1")
        end = max(0.1, round(length, 2))
        self._time = self._gui.add_slider("Time [s]", 0.0, end, 0.01, 0.0)
        self._on(self._time.on_update, "seek")

    def _choice(self, label: str, offered: Mapping[str, Any], hint: str, initial: str | None = None) -> Any:
        """Add a control that offers values by their texts, at first the first one unless another one is given."""
        control = self._gui.add_dropdown(label, tuple(offered), initial_value=initial, hint=hint)
        self._on(control.on_update, label.lower(), offered)
        return control

    def _on(self, listen: Callable[[Any], Any], name: str, meanings: Mapping[str, Any] | None = None) -> None:
        """Turn the user's changes of a control, or their `meanings`, into wishes; changes by the program are none."""

        def changed(event: Any) -> None:
            if event.client is not None:
                value = event.target.value  # which is offered: `is_needed` ignores others
                self.wishes[name] = meanings[value] if meanings else value

        listen(changed)

    def set_source(self, source: Origin) -> None:
        """Set the heading and the legend."""
        self._source = source
        title = self._stage.scenario.title
        self._head.content = f"**{_plain(title)}**  \n{_plain(source.words)}"
        self.update_legend()

    def update_legend(self) -> None:
        """Update the legend."""
        legend = legend_html(self._stage, self._source, self._look.magnification, live=True)
        self._legend.content = f'<div style="font-size:12px;padding:4px 14px">{legend}</div>'

    def set_status(self, words: str) -> None:
        """Show a line on the present activity; empty: hide it."""
        self._status.visible = bool(words)
        self._status.content = f"*{_plain(words)}*" if words else ""

    def set_playing(self, playing: bool) -> None:
        """Set the label of the play button."""
        if self._playing is not None:
            self._playing.label = "Pause" if playing else "Play"

    def pick(self, vehicle: int | None) -> None:
        """Look at a vehicle, or at none."""
        self._look.picked = vehicle
        self._vehicles.value = NONE_PICKED if vehicle is None else vehicle_mark(vehicle)
        self._image.visible = vehicle is not None
        self._plots.set_visible(vehicle is not None)
        if vehicle is None:
            self._vehicle_words.content = _PICK
        self._plots_at = -np.inf

    def show(self, frames: Sequence[Frame], now: float, exact: bool = False) -> None:
        """Show the numbers of the last frame, not more often than can be read; `now` is real time, s.

        With `exact` the time is shown in any case.
        """
        frame, rate = frames[-1], self._stage.scenario.rates.camera
        if self._time is not None and (exact or now - self._time_at >= TIME_EVERY):
            self._time_at = now
            self._time.value = round(float(frame.tick) / rate, 2)
        if now - self._texts_at >= TEXTS_EVERY:
            self._texts_at = now
            self._table.content = table_html(self._source, frame)
        picked = self._look.picked
        if picked is not None and now - self._plots_at >= PLOTS_EVERY:
            self._plots_at = now
            self._image.image = camera_image(self._stage, frame, picked)
            self._vehicle_words.content = sight_words(self._stage, frame, picked)
            self._plots.show(frames, picked, rate)


_ROW = "display:flex;gap:8px;align-items:center;line-height:1.45"
GAIN = "P is a gain matrix of this observer, not a covariance: its ellipsoids are not bounds of the error."
_DRAWINGS = {
    "block": '<rect x="2" y="2" width="18" height="8" fill="{0}" fill-opacity="{1:g}" stroke="{0}"/>',
    "disc": '<circle cx="11" cy="6" r="5" fill="{0}" fill-opacity="{1:g}" stroke="{0}"/>',
    "bead": '<circle cx="11" cy="6" r="3" fill="{0}" fill-opacity="1" stroke="{0}"/>',
    "ring": '<circle cx="11" cy="6" r="5" fill="none" stroke="{0}" stroke-width="2"/>',
    "line": '<path d="M1 6H21" stroke="{0}" stroke-width="2" stroke-dasharray="{1}"/>',
}


def legend_html(stage: Stage, source: Origin, magnification: float, live: bool = False) -> str:
    """Return the legend of the marks that can occur as HTML; `live`: a vehicle can be picked."""
    s = stage.scenario
    sensed = s.topology.mode == "sensed"
    goals = any(vehicle.goal_radius > 0 for vehicle in s.vehicles)
    times = f", {magnification:g} times as large" if magnification != 1.0 else ""
    ellipsoid = f"3σ of the estimate{times}" if source.honest else f"observer's P{times} (gain, no covariance)"
    entries: list[tuple[object, str, str, object, str]] = [
        (True, "block", BLUE, 1.0, "vehicle, true"),
        (True, "block", BLUE, 0.3, "its estimate; a dashed line joins both"),
        (True, "disc", BLUE, 0.25, ellipsoid),
        (live, "ring", BLUE, None, "protection level of the picked vehicle, if its observer states one"),
        (stage.sees_a_part, "block", BLUE, 0.15, "field of view"),
        (True, "line", BLUE, "none", "sees (colour of the observing vehicle)"),
        (sensed and s.obstacles, "line", GREY, "none", "hidden by a building, where the line ends"),
        (sensed, "line", INK, "none", "hidden by a body, where the line ends"),
        (any(camera.miss_probability > 0 for camera in s.cameras), "line", BLUE, "2 4", "in view, but missed"),
        (stage.landmarks, "disc", DARK_BLUE, 1.0, "landmark"),
        (stage.vehicles > 1, "bead", BLUE, None, "V2X message on its way"),
        (goals, "ring", BLUE, None, "its goal, at the end of its route"),
        (s.cosimulator, "block", TRAFFIC, 1.0, "other traffic"),
    ]
    svg = '<svg width="22" height="12" viewBox="0 0 22 12" style="vertical-align:middle">{}</svg>'
    rows = "".join(
        f'<div style="{_ROW}"><span style="flex:none">{svg.format(_DRAWINGS[drawing].format(colour, value))}</span>'
        f"<span>{escape(words)}</span></div>"
        for occurs, drawing, colour, value, words in entries
        if occurs
    )
    note = f'<div style="margin-top:6px;color:#8A3B00"><b>{escape(GAIN)}</b></div>' if not source.honest else ""
    return rows + note


def swatch(colour: str) -> str:
    """Return a small square in a colour, beside which text stands in ink: many colours are too pale for text."""
    look = f"width:9px;height:9px;background:{colour};border:1px solid {INK}"
    return f'<span style="display:inline-block;{look}"></span>'


def table_html(source: Origin, frame: Frame) -> str:
    """Return the table of errors as HTML."""
    sigma = "3σ [m]" if source.honest else "P, gain [m]"
    level = frame.protection_level[:, 0]
    words = [[fixed(value, 2) if np.isfinite(value) else "-"] for value in level]
    stated = bool(np.isfinite(level).any())
    heads = ["error [m]", "[deg]", sigma, "sees", *["level [m]"] * stated]
    table = [(*values, *word * stated) for values, word in zip(frame.table(), words, strict=True)]
    cells = "".join(f'<th style="{_CELL}">{name}</th>' for name in heads)
    rows = []
    for i, values in enumerate(table):
        numbers = "".join(f'<td style="{_CELL}">{value}</td>' for value in values)
        mark = f"{swatch(vehicle_colour(i))} <b>{vehicle_mark(i)}</b>"
        rows.append(f'<tr><td style="white-space:nowrap">{mark}</td>{numbers}</tr>')
    style = "width:100%;font:12px/1.3 ui-monospace,monospace;border-collapse:collapse"
    whole = f'<table style="{style}"><tr><th></th>{cells}</tr>{"".join(rows)}</table>'
    return f'<div style="padding:2px 8px;max-height:260px;overflow:auto">{whole}</div>'


def sight_words(stage: Stage, frame: Frame, vehicle: int) -> str:
    """Return a vehicle's visible, hidden and missed targets, in Markdown."""

    def names(kind: Sight) -> list[str]:
        found = []
        for target in np.flatnonzero(frame.sight[vehicle] == kind):
            hider = stage.hider(frame, vehicle, int(target))
            found.append(stage.short_name(int(target)) + (f" (by {hider})" if hider else ""))
        return found

    hidden = [*names(Sight.OCCLUDED_BY_BODY), *names(Sight.OCCLUDED_BY_BUILDING)]
    lines = ("sees", names(Sight.VISIBLE)), ("hidden", hidden), ("missed", names(Sight.MISSED))
    listed = "; ".join(f"{word} {_plain(', '.join(found))}" for word, found in lines if found)
    return f"**{vehicle_mark(vehicle)}** {listed or 'sees nothing'}"


def _plain(text: str) -> str:
    """Return a text with all Markdown characters escaped."""
    return "".join(f"\\{c}" if c in r"\`*_{}[]()#+-!|<>" else c for c in escape(text, quote=False))
