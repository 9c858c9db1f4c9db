"""Plots of one vehicle over the last seconds: error with three sigma, NEES, terms of the reward."""

from collections import deque
from html import escape
from typing import Any

import numpy as np

from coopenv.viz.error_figures import NEES_BOUNDS
from coopenv.viz.scene import Frame, Source
from coopenv.viz.style import BLUE, GREY, VEHICLE_COLOURS
from coopenv.viz.topview_geometry import semi_axes
from coopenv.viz.web.ground import swatch

_LONGEST = 600  # frames that are kept
_LEAST = 1e-4  # on a logarithmic axis
_MOST_TERMS = 6
_X: dict[str, Any] = {"x": {"time": False, "auto": True}}
_LOOK: dict[str, Any] = {
    "legend": {"show": False},
    "height": 170,
    "axes": ({"size": 28}, {"size": 52}),
    "padding": (10, 14, 0, 0),
}


class History:
    """What the plots show, of all vehicles."""

    def __init__(self, rate: float) -> None:
        """Begin with nothing; `rate` are camera ticks per second."""
        self._rate = rate
        self._frames: deque[tuple[float, Frame]] = deque(maxlen=_LONGEST)

    def add(self, frame: Frame) -> None:
        """Add a frame; one that is not later than the last one begins anew."""
        time = float(frame.tick) / self._rate
        if self._frames and time <= self._frames[-1][0]:
            self._frames.clear()
        self._frames.append((time, frame))

    def of(self, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times (K,) and error, three sigma, NEES and terms, (K, 3 + R), of a vehicle."""
        frames = [frame for _, frame in self._frames]
        plan = np.array([frame.position_covariance[vehicle, :2, :2] for frame in frames]).reshape(-1, 2, 2)
        rows = [(frame.position_error[vehicle], frame.nees[vehicle], *frame.terms[vehicle]) for frame in frames]
        return np.array([time for time, _ in self._frames]), np.insert(
            np.array(rows), 1, semi_axes(plan)[0][:, -1], axis=1
        )


class Plots:
    """Charts in viser's panel."""

    def __init__(self, gui: Any, source: Source) -> None:
        """Add them, empty."""
        self._terms = source.terms[:_MOST_TERMS]
        sigma = "3σ" if source.honest else "P, a gain"
        start = np.array([0.0, 1.0])
        log: dict[str, Any] = {**_X, "y": {"distr": 3, "log": 10, "auto": True}}
        start, one = np.array([0.0, 1.0]), np.ones(2)
        error, pair = ("error", BLUE), (start, one, one)
        title = f"Position error [m]; dashed: {sigma}"
        self._error = gui.add_uplot(pair, _series(error, ("3σ", GREY)), title=title, scales=log, **_LOOK)
        title, bounds = "NEES; dashed: 95 % of honest ones", (("from", GREY), ("to", GREY))
        self._nees = gui.add_uplot((*pair, one), _series(("NEES", BLUE), *bounds), title=title, scales=log, **_LOOK)
        self._reward: Any = None
        if self._terms:
            named = list(zip(self._terms, VEHICLE_COLOURS, strict=False))
            data = (start, *(np.zeros(2) for _ in named))
            self._reward = gui.add_uplot(data, _series(*named), title="Reward terms", scales=dict(_X), **_LOOK)
            words = " &nbsp; ".join(f"{swatch(colour)} {escape(name)}" for name, colour in named)
            gui.add_html(f'<div style="font-size:12px;padding:0 14px">{words}</div>')

    def show(self, history: History, vehicle: int) -> None:
        """Show the last seconds of a vehicle."""
        time, values = history.of(vehicle)
        if len(time) < 2:
            return
        error, sigma, nees = (_positive(values[:, k]) for k in range(3))
        self._error.data = (time, error, sigma)
        bound = np.ones_like(time)
        self._nees.data = (time, nees, NEES_BOUNDS[0] * bound, NEES_BOUNDS[1] * bound)
        if self._reward is not None:
            terms = np.nan_to_num(values[:, 3 : 3 + len(self._terms)])
            self._reward.data = (time, *np.ascontiguousarray(terms.T))


def _series(*named: tuple[str, str]) -> tuple[dict[str, Any], ...]:
    rows: list[dict[str, Any]] = [{"label": "t [s]"}]
    for label, colour in named:
        dashes = {"dash": [5, 4]} if label in ("3σ", "from", "to") else {}
        rows.append({"label": label, "stroke": colour, "width": 2, "points": {"show": False}, **dashes})
    return tuple(rows)


def _positive(values: np.ndarray) -> np.ndarray:
    """Return values that a logarithmic axis can show; what is no number is as the last one that was."""
    good = np.isfinite(values)
    last = np.maximum.accumulate(np.where(good, np.arange(len(values)), 0))
    filled = values[last]
    return np.asarray(np.clip(np.where(np.isfinite(filled), filled, 1.0), _LEAST, 1e6))
