"""Topics and layout for Foxglove and Lichtblick: scene, transforms, cameras and estimates of a recording.

Messages are of Foxglove's published types, which its SDK encodes; the extra `log` brings it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from coopenv.base.installation import install_command, needing
from coopenv.viz.style import vehicle_colour

if TYPE_CHECKING:
    from coopenv.episode import Episode
    from coopenv.sources.mcap_format import View


def check_installed() -> None:
    """Check that Foxglove's SDK is installed, before any work.

    Raises:
        CoopenvError: it is not.
    """
    with needing(f"scenes for Foxglove need an extra: {install_command('log')}, or --no-scene"):
        import foxglove.messages  # noqa: F401


def views(episode: Episode, *, start: float = 0.0) -> list[View]:
    """Return the topics that Foxglove and Lichtblick show, to give to `write_recording`.

    Args:
        episode: with the recording of its measurements.
        start: s since 1970, when tick 0 was.

    Raises:
        CoopenvError: Foxglove's SDK is not installed, or the episode has no recording.
    """
    check_installed()
    from coopenv.foxglove.messages import LogView, topics
    from coopenv.sources.mcap_format import LogClock

    return topics(LogView(episode, LogClock(episode.measured.dt, start)))


_PLOTS = {
    "Plot!position": ("position_error_m", "position error [m]"),
    "Plot!orientation": ("orientation_error_deg", "orientation error [deg]"),
}


def layout_text(topics: Sequence[str]) -> str:
    """Return the layout for a log with these topics as JSON, to import as `foxglove_layout.json`."""
    vehicles = [topic.split("/")[1] for topic in topics if topic.endswith("/error")]
    cameras = [topic.removesuffix("/camera/image") for topic in topics if topic.endswith("/camera/image")]
    panels: dict[str, Any] = {"3D!scene": _scene(topics)}
    panels |= {name: _plot(vehicles, *column) for name, column in _PLOTS.items()}
    side: Any = _split(*_PLOTS, direction="column")
    if cameras:
        panels["Image!camera"] = _image(cameras[0])
        side = _split("Image!camera", side, direction="column", share=40)
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("3D!scene", side, direction="row", share=62),
    }
    return json.dumps(document, indent=2) + "\n"


def _scene(topics: Sequence[str]) -> dict[str, Any]:
    visible = {topic: {"visible": True} for topic in topics if topic.startswith("/scene/")}
    hidden = {topic: {"visible": False} for topic in topics if topic.endswith(("/odometry", "/truth", "/estimate"))}
    camera = {"distance": 60, "perspective": True, "phi": 50, "thetaOffset": 30, "targetOffset": [0, 0, 0]}
    grid = {"visible": True, "frameLocked": True, "label": "Grid", "instanceId": "grid", "layerId": "foxglove.Grid"}
    return {
        "cameraState": {**camera, "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1], "fovy": 45, "near": 0.1},
        "followTf": "map",
        "followMode": "follow-none",
        "scene": {"transforms": {"showLabel": False, "axisScale": 0}},
        "topics": {**visible, **hidden},
        "layers": {"grid": {**grid, "size": 100, "divisions": 20, "lineWidth": 1, "color": "#248eff20"}},
    }


def _image(vehicle: str) -> dict[str, Any]:
    mode = {
        "imageTopic": f"{vehicle}/camera/image",
        "calibrationTopic": f"{vehicle}/camera/calibration",
        "annotations": {f"{vehicle}/camera/annotations": {"visible": True}},
        "synchronize": False,
    }
    return {"imageMode": mode, "foxglovePanelTitle": f"camera of {vehicle.strip('/')}"}


def _plot(vehicles: Sequence[str], column: str, title: str) -> dict[str, Any]:
    paths = [
        {
            "value": f"/{vehicle}/error.{column}",
            "label": vehicle,
            "color": vehicle_colour(i),
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for i, vehicle in enumerate(vehicles)
    ]
    axes = {"showXAxisLabels": True, "showYAxisLabels": True, "xAxisVal": "timestamp", "isSynced": True}
    legend = {"showLegend": True, "legendDisplay": "floating", "showPlotValuesInLegend": True}
    return {"paths": paths, "foxglovePanelTitle": title, **axes, **legend, "sidebarDimension": 240}


def _split(first: Any, second: Any, *, direction: str, share: int = 50) -> dict[str, Any]:
    return {"first": first, "second": second, "direction": direction, "splitPercentage": share}
