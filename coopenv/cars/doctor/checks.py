"""The table of checks: what is compared, and the treatment of the causes of a contradiction."""

from typing import NamedTuple


class StreamCheck(NamedTuple):
    """A check of a stream against others."""

    stream: str
    references: str
    causes: str  # and their treatment


CHECKS = (
    StreamCheck("turn rates", "motion capture, bearings, commands", "sign, unit: mended; zero, stuck, axes: refused"),
    StreamCheck("velocities", "motion capture, own poses", "sign, unit, frame: mended; zero, stuck, axes: refused"),
    StreamCheck("motion capture", "bearings, wheels", "unit, mirror, heading, frame: warning; repeated: left out"),
    StreamCheck("map, markers", "bearings", "unit, mirror, exchange: refused"),
    StreamCheck("camera", "map", "mounting, focal length, mirror: refused"),
    StreamCheck("constants", "`calibrate`", "warning"),
    StreamCheck("detections", "quality; image size", "left out; warning"),
    StreamCheck("clocks", "recorder", "simulation time: mended"),
)
"""In the order in which streams are looked at; a list of the documentation."""


def listed_checks() -> str:
    """Return the table of checks as a list in Markdown."""
    return "".join(f"- {check.stream} ({check.references}): {check.causes}\n" for check in CHECKS)
