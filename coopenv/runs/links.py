"""What a run on cars says of its links: what came, what was refused, and how well time was kept."""

from math import isfinite
from pathlib import Path

from rich.console import Console
from rich.table import Table

from coopenv.base.errors import listed
from coopenv.cars.backend.backend import Svea
from coopenv.cars.profile import Role

STEADY_FROM = 2.0
"""s: cars know their places by then."""


def links_line(backend: Svea) -> str:
    """Return the state of the links in a few words, for a line that is shown while it runs."""
    parts = []
    for vehicle in backend.binding.local:
        notes = backend.notes(vehicle)
        refused = sum(notes["gate_rejections"].values()) + sum(backend.intake.rejected[notes["name"]].values())
        parts.append(f"{notes['name']} {notes['gate']}" + (f", {refused} refused" if refused else ""))
    late = f"; {backend.link.missed} deadlines missed" if backend.link.missed else ""
    return "; ".join(parts) + late


def kept_drive(path: Path | None, backend: Svea) -> str:
    """Return what is told of a drive's record when the drive is interrupted; empty where there is nothing to replay."""
    if path is None or backend.recorder is None or not backend.recorder.begun:
        return ""
    return f"kept: {path}, the drive up to here: coopenv run {path}"


def links_report(backend: Svea, out: Console) -> None:
    """Print a table with a row per car, and a line on time and on why it ended."""
    health, cars = backend.link, backend.binding
    table = Table(title="Links", title_justify="left", box=None)
    for name in ("car", "gate", "clock offset", "messages refused", "gate refused"):
        table.add_column(name, justify="left" if name in ("car", "gate") else "right")
    for vehicle in cars.local:
        notes = backend.notes(vehicle)
        offset = f"{1e3 * notes['clock_offset']:.1f} ms"
        refused = str(sum(backend.intake.rejected[notes["name"]].values()))
        table.add_row(notes["name"], notes["gate"], offset, refused, str(sum(notes["gate_rejections"].values())))
    out.print(table)
    late = 1e3 * backend.lateness(0.99)
    out.print(
        f"{health.received} messages, {health.ticks} ticks, {health.missed} missed deadlines, "
        f"wake-up lateness p99 {late:.2f} ms",
        soft_wrap=True,
    )
    if left_out := [f"{name} {count}" for name, count in health.refused.items() if count]:
        out.print(f"Left out: {', '.join(left_out)}", soft_wrap=True)
    trip = backend.watchdog.trip
    if trip is not None:
        out.print(f"Stopped: {trip.reason}", soft_wrap=True)


def truth_report(backend: Svea) -> str:
    """Return why no tick has true poses: no car sends, or by topic of motion capture what came."""
    names = list(backend.binding.cars)
    if not backend.health.received:
        where = ", ".join(backend.deployment.network.connect)
        return f"nothing has come from {listed(names)} by {where}: are they on, and are their names fleet/NAME/...?"
    topics = [backend.binding.profile.topic_of(name, Role.TRUTH) for name in names]
    came = [topic for topic in topics if isfinite(backend.station.silence(topic))]
    silent = [topic for topic in topics if topic not in came]
    parts = [f"nothing came on {listed(silent)}"] if silent else []
    parts += [f"messages on {listed(came)} came too late for the ticks"] if came else []
    return "no true poses are known, so there are no errors to show: " + "; ".join(parts)
