"""`python -m benchmarks.city`: what localisation costs in a city, and how the cost grows.

Every observer estimates on the same drives in the city as it is shipped, over held-out worlds. An observer on the host
keeps all targets, so `topology.most_nearby` is left out for it; nothing else differs. CPU time on one thread and memory
are measured with 64 to 1,024 vehicles at the same density. Results are the file `city.json` in a folder; `--page
docs/environments` makes the figure and the tables for the environment's page of them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.machine import machine
from benchmarks.options import at_least
from coopenv import EVALUATION_SEEDS, load_scenario
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, ScenarioWarning, check_one_of
from coopenv.base.files import replace_text
from coopenv.base.format import in_parentheses, json_text
from coopenv.base.installation import version
from coopenv.base.seeds import world_keys
from coopenv.bench.pages import fingerprint
from coopenv.observers.registry import find_embedded, list_observers
from coopenv.runs.console import Progress
from coopenv.scenario import Scenario
from coopenv.viz import style

OBSERVERS = (
    "robust",
    "schmidt_kalman",
    "split_covariance_intersection",
    "mekf_covariance",
    "riccati",
    "dead_reckoning",
)
FIRST, SECONDS = 10.0, 30.0
"""s of an episode that are left out, and its length."""
KNOWN = 0.2
"""m, the error of a vehicle that knows its place."""
DISTANCES = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, np.inf)
"""m, limits of the bins of the horizontal distance to the nearest landmark."""
SIZES = (64, 128, 256, 512, 1024)
AT_REST = 0.9
"""Share of the vehicles that are there from the start."""
FIGURE = "../images/city.png"
"""From the folder of the pages."""
RECORDED = (
    "`coopenv run` also records. With 1,000 vehicles over 9 s it takes 7 s of CPU time per simulated second, "
    "slower than real time."
)
TIMED, SETTLED = 10.0, 3.0
"""s that are timed, after so many."""


def city(overrides: dict[str, Any]) -> Scenario:
    """Return the shipped city with overrides."""
    with warnings.catch_warnings(action="ignore", category=ScenarioWarning):
        return load_scenario("city", overrides)


def of_size(vehicles: int, observer: str) -> Scenario:
    """Return a city with other numbers of vehicles and blocks, at the density of the shipped one."""
    shipped = city({})
    area = len(shipped.obstacles) * vehicles / len(shipped.vehicles)
    columns = max(1, round(math.sqrt(area)))
    there = round(AT_REST * vehicles)
    blocks = [columns, max(1, round(area / columns))]
    counts = {"vehicles.0.count": there, "vehicles.1.count": vehicles - there}
    return city({"streets.blocks": blocks, **counts, "observer.name": observer, "horizon": SETTLED + TIMED})


def area_of(scenario: Scenario) -> float:
    """Return the area of the city, km^2: the rectangle about its streets."""
    ends = np.array([end for road in scenario.roads for end in (road.start, road.end)])
    return float(np.prod(np.ptp(ends, axis=0)) / 1e6)


def decisions(engine: Engine, seed: int) -> Iterator[float]:
    """Yield the time, s, after every decision of an episode."""
    scenario = engine.backend.scenario
    idle = np.zeros((1, len(scenario.vehicles), scenario.action_size), dtype=engine.world.precision.numpy)
    engine.reset(world_keys(seed))
    for k in range(1, scenario.horizon_ticks // scenario.ticks_per_decision + 1):
        engine.step(idle)
        yield k / scenario.rates.decision


def samples(engine: Engine, seed: int) -> dict[str, np.ndarray]:
    """Return error (m), distance to the nearest landmark (m) per second and vehicle, and bytes per decision.

    The radio's period is a decision, so that a vehicle that sends sends once.
    """
    landmarks = len(engine.backend.scenario.landmarks)
    errors, distances, sent, senders = [], [], [], []
    before = np.zeros(len(engine.backend.scenario.vehicles))
    for now in decisions(engine, seed):
        present = engine.view("present")[0, landmarks:] == 1
        made = engine.view("bytes_sent")[0]
        if engine.plugins is not None:  # their groups count from the reset on
            total = engine.plugins.groups[0].mail.bytes.copy()
            made, before = (total - before) * present, total
        if now < FIRST:
            continue
        sent.append(made.sum())
        senders.append((made > 0).sum())
        if now % 1.0 < 1e-6:
            R, p = engine.view("estimate_rotation")[0], engine.view("estimate_position")[0]
            true = engine.view("position")[0]
            estimated = (R @ p[..., None])[..., 0]
            errors.append(np.linalg.norm(estimated - true[landmarks:], axis=1)[present])
            apart = true[landmarks:, None, :2] - true[None, :landmarks, :2]
            distances.append(np.linalg.norm(apart, axis=2).min(axis=1)[present])
    return {
        "error": np.concatenate(errors),
        "distance": np.concatenate(distances),
        "bytes": np.array(sent),
        "senders": np.array(senders),
        "present": np.array([len(row) for row in errors]),
    }


def study(observer: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return figures of an observer over worlds, each as (mean, standard error)."""
    host = find_embedded(observer) is None
    scenario = city({"observer.name": observer, "horizon": SECONDS, **({"topology.most_nearby": None} if host else {})})
    found, began = [], time.process_time()
    with closing(Engine(scenario, dtype="float64", threads=1)) as engine:
        engine.load()
        began = time.process_time()
        for seed in seeds:
            found.append(samples(engine, seed))
    took = time.process_time() - began
    area, rate = area_of(scenario), scenario.rates.decision
    rows: dict[str, list[float]] = {
        "known": [float((one["error"] <= KNOWN).mean()) for one in found],
        "median_error": [float(np.median(one["error"])) for one in found],
        "p95_error": [float(np.percentile(one["error"], 95)) for one in found],
        "vehicles": [float(one["present"].mean()) for one in found],
        "messages_per_s_km2": [float(one["senders"].mean() * rate / area) for one in found],
        "bytes_per_s_km2": [float(one["bytes"].mean() * rate / area) for one in found],
        "bytes_per_message": [float(one["bytes"].sum() / max(one["senders"].sum(), 1)) for one in found],
    }
    by_distance = []
    for low, high in pairwise(DISTANCES):
        chosen = [one["error"][(one["distance"] >= low) & (one["distance"] < high)] for one in found]
        some = [values for values in chosen if len(values)]
        entry: dict[str, Any] = {
            "from": low,
            "to": high if np.isfinite(high) else None,
            "samples": sum(map(len, chosen)),
        }
        entry |= {
            "median_error": _mean([np.median(v) for v in some]),
            "known": _mean([(v <= KNOWN).mean() for v in some]),
        }
        by_distance.append(entry)
    per_second = took / (len(found) * SECONDS)
    figures = {name: _mean(values) for name, values in rows.items()}
    return {"observer": observer, **figures, "cpu_s_per_s": per_second, "by_distance": by_distance}


def _mean(values: Sequence[float]) -> tuple[float, float] | None:
    """Return mean and standard error; None: no values."""
    if not len(values):
        return None
    spread = float(np.std(values, ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
    return float(np.mean(values)), spread


def growth(observer: str, vehicles: int, seed: int) -> dict[str, Any]:
    """Return CPU time per simulated second on one thread, and what else grows with the vehicles."""
    began = time.process_time()
    scenario = of_size(vehicles, observer)
    with closing(Engine(scenario, dtype="float32", threads=1)) as engine:
        held = sum(array.numpy().nbytes for array in engine.world.state_arrays().values())
        engine.load()
        loaded, start, present = time.process_time() - began, 0.0, []
        for now in decisions(engine, seed):
            if abs(now - SETTLED) < 1e-6:
                start = time.process_time()
            present.append(engine.view("present")[0, len(scenario.landmarks) :].sum())
        took = (time.process_time() - start) / TIMED
        kept = int(engine.view("kept_count").max())
    return {
        "observer": observer,
        "vehicles": vehicles,
        "present": float(np.mean(present)),
        "buildings": len(scenario.obstacles),
        "landmarks": len(scenario.landmarks),
        "area_km2": area_of(scenario),
        "cpu_s_per_s": took,
        "times_real_time": 1.0 / took,
        "bytes": held,
        "most_kept": kept,
        "load_cpu_s": loaded,
    }


def exponent(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Return the least-squares slope of a quantity over the vehicles that are there, in logarithms."""
    return float(np.polyfit(np.log([row["present"] for row in rows]), np.log([row[key] for row in rows]), 1)[0])


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = (f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), *rows))
    return "\n".join(lines)


def observers_table(studies: Sequence[dict[str, Any]]) -> str:
    """Return the table of the observers."""
    columns = (
        "observer",
        "known to 20 cm [%]",
        "median error [cm]",
        "95 % [cm]",
        "message [byte]",
        "messages [1/(s km^2)]",
        "[kbyte/(s km^2)]",
        "CPU time per s [s]",
    )

    def cells(row: dict[str, Any]) -> list[str]:
        scales = {"known": 100.0, "median_error": 100.0, "p95_error": 100.0, "bytes_per_message": 1.0}
        scales |= {"messages_per_s_km2": 1.0, "bytes_per_s_km2": 1e-3}
        values = [in_parentheses(*(scale * x for x in row[name])) for name, scale in scales.items()]
        return [f"`{row['observer']}`", *values, f"{row['cpu_s_per_s']:.2g}"]

    return table(columns, [cells(row) for row in studies])


def distance_table(studies: Sequence[dict[str, Any]]) -> str:
    """Return the table of the errors over the distance to the nearest landmark."""
    first = studies[0]["by_distance"]
    names = [f"above {e['from']:g}" if e["to"] is None else f"{e['from']:g} to {e['to']:g}" for e in first]
    rows = []
    for row in studies:
        cells = [
            e["median_error"] and in_parentheses(*(100.0 * x for x in e["median_error"])) for e in row["by_distance"]
        ]
        rows.append([f"`{row['observer']}`", *(cell or "-" for cell in cells)])
    return table(["median error [cm] by distance [m]", *names], rows)


def size_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of the sizes."""
    columns = (
        "observer",
        "vehicles",
        "present",
        "buildings",
        "landmarks",
        "CPU time per s [s]",
        "times real time",
        "[kbyte/vehicle]",
    )
    cells = [
        [
            f"`{row['observer']}`",
            f"{row['vehicles']:,}",
            f"{row['present']:,.0f}",
            f"{row['buildings']:,}",
            f"{row['landmarks']:,}",
            f"{row['cpu_s_per_s']:.3g}",
            f"{row['times_real_time']:.3g}",
            f"{row['bytes'] / row['vehicles'] / 1e3:.3g}",
        ]
        for row in rows
    ]
    return table(columns, cells)


def draw(studies: Sequence[dict[str, Any]], sizes: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw errors over the distance to the nearest landmark, and CPU time over vehicles."""
    figure = style.new_figure(8.4, 3.6)
    left, right = figure.subplots(1, 2)
    for k, row in enumerate(studies):
        bins = [e for e in row["by_distance"] if e["median_error"]]
        x = [(e["from"] + (e["to"] or e["from"] + 10.0)) / 2 for e in bins]
        left.plot(
            x,
            [100 * e["median_error"][0] for e in bins],
            marker="o",
            color=style.vehicle_colour(k),
            label=row["observer"],
        )
    left.set_yscale("log")
    style.tidy(left, x_label="distance to the nearest landmark [m]", y_label="median position error [cm]")
    left.legend(fontsize=style.SMALL, frameon=False, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for k, name in enumerate(dict.fromkeys(row["observer"] for row in sizes)):
        rows = [row for row in sizes if row["observer"] == name]
        label = f"{name}: exponent {exponent(rows, 'cpu_s_per_s'):.2f}"
        look = {"marker": "o", "color": style.vehicle_colour(k), "label": label}
        right.loglog([row["vehicles"] for row in rows], [row["cpu_s_per_s"] for row in rows], **look)
    right.axhline(1.0, color=style.GREY, linewidth=0.8)
    style.tidy(right, x_label="vehicles", y_label="CPU time per simulated second [s]")
    right.legend(fontsize=style.SMALL, frameon=False)
    figure.tight_layout()
    style.save(figure, path)


def measure(observers: Sequence[str], worlds: int, sizes: Sequence[int]) -> dict[str, Any]:
    """Return what is found of observers, in so many worlds, and of sizes."""
    seeds = [EVALUATION_SEEDS[k] for k in range(worlds)]
    jobs: list[tuple[Any, ...]] = [(study, name, seeds) for name in observers]
    jobs += [(growth, name, size, seeds[0]) for name in ("riccati", "robust") for size in sizes]
    results: dict[str, Any] = {"machine": machine(), "worlds": worlds, "observers": [], "sizes": []}
    with Progress(Console(stderr=True), "city", total=len(jobs)) as progress:
        for done, (job, *given) in enumerate(jobs):
            progress.update(done)
            results["observers" if job is study else "sizes"].append(job(*given))
    return results


def report(results: dict[str, Any]) -> str:
    """Return the tables in Markdown, with the commands that give them."""
    parts = ["## What localisation costs"]
    if studies := results["observers"]:
        parts += [
            f"Position errors of the vehicles in the city from {FIRST:g} s to {SECONDS:g} s, over {results['worlds']} "
            "held-out worlds, with standard errors; distances are those to the nearest landmark. Observers on the host "
            "keep all targets, which limits them to hundreds of vehicles: with `topology.most_nearby` only `riccati`, "
            "`robust` and `dead_reckoning` run. CPU time is per simulated second, on one thread.",
            observers_table(studies),
            distance_table(studies),
        ]
    if rows := results["sizes"]:
        fits = {name: [row for row in rows if row["observer"] == name] for name in ("riccati", "robust")}
        words = [
            f"`{name}` {exponent(own, 'cpu_s_per_s'):.2f} (time), {exponent(own, 'bytes'):.2f} (memory)"
            for name, own in fits.items()
        ]
        parts += ["## Size", "On one thread, float32.", size_table(rows), f"Exponents: {'; '.join(words)}."]
        parts.append(RECORDED)
        parts.append(f"![Errors over the distance to a landmark, and CPU time over vehicles]({FIGURE})")
    parts.append(f"```\npython -m benchmarks.city --worlds {results['worlds']}  # coopenv {version()}\n```")
    return "\n\n".join(parts)


def numbers(text: str) -> list[int]:
    """Return numbers with commas between."""
    return [int(at_least(1)(part)) for part in text.split(",") if part]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and write the results; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.city", description=__doc__)
    parser.add_argument("--observers", default=",".join(OBSERVERS), help="names with commas between; empty: none")
    parser.add_argument("--worlds", type=at_least(1), default=4, help="worlds per observer (default: 4)")
    parser.add_argument("--sizes", type=numbers, default=list(SIZES), help="of vehicles, likewise")
    parser.add_argument("--out", type=Path, default=Path("out", "city"), help="folder (default: out/city)")
    parser.add_argument("--page", type=Path, help="folder of the environments' pages: nothing is measured")
    asked = parser.parse_args(arguments)
    file, observers = asked.out / "city.json", [name for name in asked.observers.split(",") if name]
    try:
        for name in observers:
            check_one_of("--observers: unknown observer", name, list_observers())
        if asked.page:
            if not file.is_file():
                raise CoopenvError(f"--page: no {file}; without --page the command measures it")
            results = json.loads(file.read_text(encoding="utf-8"))
        else:
            asked.out.mkdir(parents=True, exist_ok=True)
            results = measure(observers, asked.worlds, asked.sizes)
            replace_text(file, json_text(results))
    except (CoopenvError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    text = report(results)
    print(text)
    if asked.page:
        value = {"coopenv": version(), "worlds": results["worlds"], "scenario": fingerprint(city({}))}
        replace_text(asked.page / "city.json", json_text({**value, "text": text}))
        draw(results["observers"], results["sizes"], asked.page / FIGURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
