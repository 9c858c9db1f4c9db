"""What a run on cars says of its links: what came, what was refused, and how well time was kept."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from coopenv.base.errors import CoopenvError, listed
from coopenv.cars.backend.backend import Svea

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
    if path is None or backend.tape is None or not backend.tape.begun:
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


def silence(backend: Svea) -> CoopenvError | None:
    """Return what is wrong where no car has said anything, None if one has."""
    if backend.health.received:
        return None
    names, where = listed(list(backend.binding.cars)), ", ".join(backend.deployment.network.connect)
    return CoopenvError(f"nothing has come from {names} by {where}: are they on, and are their names fleet/NAME/...?")
