"""What the marks in the browser mean, and what a scene is of, as HTML."""

from html import escape

from coopenv.viz.scene import Source, Stage
from coopenv.viz.style import BLUE, DARK_BLUE, GREY, INK
from coopenv.viz.topview_ground import TRAFFIC

_ROW = "display:flex;gap:8px;align-items:center;line-height:1.45"
GAIN = "P is a gain matrix of this observer, not a covariance: its ellipsoids say nothing about the error."


def ellipsoid_words(source: Source, magnification: float) -> str:
    """Return what an ellipsoid shows."""
    times = f", {magnification:g} times as large" if magnification != 1.0 else ""
    return f"3σ of the estimate{times}" if source.honest else f"observer's P{times} (gain, no covariance)"


def marks(stage: Stage, source: Source, magnification: float) -> list[tuple[str, str]]:
    """Return drawings and words of the marks that can occur."""
    s = stage.scenario
    sensed = s.topology.mode == "sensed"
    entries = [
        (True, _block(BLUE, 1.0), "vehicle, true"),
        (True, _block(BLUE, 0.3), "its estimate; a dashed line joins both"),
        (True, _disc(BLUE, 0.25), ellipsoid_words(source, magnification)),
        (stage.sees_a_part, _block(BLUE, 0.15), "field of view"),
        (True, _line(BLUE), "sees (colour of who looks)"),
        (sensed and bool(s.obstacles), _line(GREY), "hidden by a building, where the line ends"),
        (sensed, _line(INK), "hidden by a body, where the line ends"),
        (any(camera.miss_probability > 0 for camera in s.cameras), _line(BLUE, "2 4"), "in view, but missed"),
        (stage.landmarks > 0, _disc(DARK_BLUE, 1.0), "landmark"),
        (stage.vehicles > 1, _disc(BLUE, 1.0, 3), "V2X message on its way"),
        (any(vehicle.goal_radius > 0 for vehicle in s.vehicles), _ring(BLUE), "its goal, at the end of its route"),
        (s.highway is not None, _block(TRAFFIC, 1.0), "other traffic"),
    ]
    return [(drawing, words) for occurs, drawing, words in entries if occurs]


def legend_html(stage: Stage, source: Source, magnification: float) -> str:
    """Return the legend as HTML."""
    rows = "".join(
        f'<div style="{_ROW}"><span style="flex:none">{drawing}</span><span>{escape(words)}</span></div>'
        for drawing, words in marks(stage, source, magnification)
    )
    note = f'<div style="margin-top:6px;color:#8A3B00"><b>{escape(GAIN)}</b></div>' if not source.honest else ""
    return rows + note


def swatch(colour: str) -> str:
    """Return a small square in a colour, beside which text stands in ink: many colours are too pale for text."""
    look = f"width:9px;height:9px;background:{colour};border:1px solid {INK}"
    return f'<span style="display:inline-block;{look}"></span>'


def _svg(content: str) -> str:
    return f'<svg width="22" height="12" viewBox="0 0 22 12" style="vertical-align:middle">{content}</svg>'


def _block(colour: str, opacity: float) -> str:
    look = f'fill="{colour}" fill-opacity="{opacity:g}" stroke="{colour}"'
    return _svg(f'<rect x="2" y="2" width="18" height="8" {look}/>')


def _disc(colour: str, opacity: float, radius: int = 5) -> str:
    return _svg(f'<circle cx="11" cy="6" r="{radius}" fill="{colour}" fill-opacity="{opacity:g}" stroke="{colour}"/>')


def _ring(colour: str) -> str:
    return _svg(f'<circle cx="11" cy="6" r="5" fill="none" stroke="{colour}" stroke-width="2"/>')


def _line(colour: str, dashes: str = "") -> str:
    return _svg(f'<path d="M1 6H21" stroke="{colour}" stroke-width="2" stroke-dasharray="{dashes or "none"}"/>')
