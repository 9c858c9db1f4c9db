"""`python -m benchmarks.contact ENV`: what measurements between vehicles are worth where nothing else localises them.

Observers estimate twice on the same drives: with all measurements, and without the measurements of other vehicles.
Counted are moments at which a vehicle has had no measurement of the map for a second. Below the errors stands the least
possible error, the bound. `--page docs/environments` writes the table to the file that the environment's page shows,
beside the results of the drivers from their cards.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.options import at_least
from coopenv import EVALUATION_SEEDS, load_scenario
from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.files import replace_text
from coopenv.base.format import in_parentheses, json_text
from coopenv.base.installation import version
from coopenv.estimation.poses import Array
from coopenv.observers.bound import cramer_rao
from coopenv.observers.recording import Recording
from coopenv.observers.runner import run
from coopenv.report.table import markdown
from coopenv.runs.console import Progress
from coopenv.runs.recorder import record
from sitegen.environments.sensing import fingerprint

LOCATING = {"underpass": ("position",), "warehouse": ("tags", "uwb")}
"""Sensors that measure the map or landmarks of an environment, apart from heights and headings."""
BOUND = "bound"
DRIVERS = ("route_follower", "keep_contact")
SILENT = 1.0
"""s without a measurement of the map from which a vehicle's error counts."""
CARDS = Path(__file__).parents[1] / "agents"


def without_vehicles(recording: Recording) -> Recording:
    """Return a record in which no vehicle has measured another one."""
    first, kept = recording.landmarks.shape[1], {}
    for name, values in recording.readings.items():
        vehicle = np.arange(values.shape[2])[:, None] >= (first if values.shape[2] > 1 else 1)
        kept[name] = np.where(vehicle, np.nan, values)
    return replace(recording, readings=kept)


def unaided(recording: Recording, sensors: Sequence[str]) -> NDArray[np.bool_]:
    """Return (K, N) at which ticks a vehicle that is there has had no measurement by some sensors for `SILENT`."""
    alone = without_vehicles(recording).readings
    measured = np.any([np.isfinite(alone[name]).all(axis=-1).any(axis=-1) for name in sensors], axis=0)
    last = np.maximum.accumulate(np.where(measured, np.arange(len(measured))[:, None], -1), axis=0)
    silent = np.arange(len(measured))[:, None] - last > SILENT / recording.dt
    return np.asarray(silent & np.isfinite(recording.truth.position).all(axis=-1)) if recording.truth else silent


def errors(recording: Recording, observer: str) -> Array:
    """Return the position errors (K, N) of an observer on a record, or the bound on them, m.

    Raises:
        CoopenvError: the observer fails.
    """
    if observer == BOUND:
        return cramer_rao(recording).position
    found = run(observer, recording)
    if found.failure:
        raise CoopenvError(f"{observer}: {found.failure}")
    return found.position_error


def measure(
    environment: str, driver: str, observers: Sequence[str], seeds: Sequence[int], seconds: float
) -> dict[str, list[list[float]]]:
    """Return root mean square errors (seeds, 2), m, of observers: without measurements of vehicles, and with them."""
    found: dict[str, list[list[float]]] = {name: [] for name in (*observers, BOUND)}
    scenario = load_scenario(environment, {"horizon": seconds})
    with Progress(Console(stderr=True), environment, total=len(seeds)) as progress:
        for done, seed in enumerate(seeds):
            progress.update(done)
            made = record(scenario, seed, driver)
            counted = unaided(made, LOCATING[environment])
            for name, rows in found.items():
                both = [errors(part, name) for part in (without_vehicles(made), made)]
                rows.append([float(np.sqrt(np.mean(error[counted] ** 2))) for error in both])
    return found


def report(environment: str, driver: str, seconds: float, found: dict[str, list[list[float]]]) -> str:
    """Return the tables in Markdown, with the command that gives them."""
    rows = []
    for name, values in found.items():
        errors = np.array(values)
        share = errors[:, 1] / errors[:, 0]
        rows.append([name, *(_with_error(column) for column in (*errors.T, share))])
    columns = ["observer", "without [m]", "with [m]", "with / without"]
    worlds = len(found[BOUND])
    command = f"python -m benchmarks.contact {environment} --worlds {worlds} --seconds {seconds:g}"
    return "\n\n".join(
        [
            "## What contact is worth",
            f"Root mean square errors of vehicles that nothing but other vehicles has localised for {SILENT:g} s, "
            f"without and with measurements of other vehicles, driven by `{driver}`, over {worlds} held-out worlds, "
            "with standard errors. No observer has a smaller error than the bound, on average.",
            markdown(columns, rows),
            "Position errors of all vehicles by the driver, with 95 % intervals:",
            drivers_table(environment),
            f"```\n{command}  # coopenv {version()}\n```",
        ]
    )


def _with_error(values: Array) -> str:
    return in_parentheses(float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values))))


def drivers_table(environment: str) -> str:
    """Return the results of the drivers by their cards."""
    rows = []
    for driver in DRIVERS:
        card = json.loads((CARDS / driver / "card.json").read_text(encoding="utf-8"))["environments"][environment]
        results = card["results"]
        cells = []
        for name, scale in (("e50_m", 100.0), ("e95_m", 100.0), ("travel_time_s", 1.0)):
            mean, low, high = (scale * results[name][key] for key in ("mean", "ci_low", "ci_high"))
            cells.append(f"{mean:.0f} [{low:.0f}, {high:.0f}]")
        rows.append([f"`{driver}`", str(card["worlds"]), *cells])
    return markdown(["driver", "worlds", "e50 [cm]", "e95 [cm]", "travel [s]"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the tables; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.contact", description=__doc__)
    parser.add_argument("environment", metavar="ENV", help=" or ".join(LOCATING))
    parser.add_argument("--observers", default="robust", help="names with commas between (default: robust)")
    parser.add_argument("--driver", default="keep_contact", help="agent that drives (default: keep_contact)")
    parser.add_argument("--worlds", type=at_least(2), default=10, help="held-out worlds (default: 10)")
    parser.add_argument("--seconds", type=float, default=40.0, help="of an episode (default: 40)")
    parser.add_argument("--page", type=Path, help="folder of the environments' pages")
    asked = parser.parse_args(arguments)
    try:
        check_one_of("unknown environment", asked.environment, LOCATING)
        seeds = [EVALUATION_SEEDS[k] for k in range(asked.worlds)]
        found = measure(asked.environment, asked.driver, asked.observers.split(","), seeds, asked.seconds)
        text = report(asked.environment, asked.driver, asked.seconds, found)
    except (CoopenvError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text)
    if asked.page:
        scene = fingerprint(load_scenario(asked.environment))
        value = {"coopenv": version(), "worlds": asked.worlds, "scenario": scene}
        replace_text(asked.page / f"{asked.environment}.json", json_text({**value, "text": text}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
