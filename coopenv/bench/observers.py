"""Observers compared on the same simulated ticks: Monte Carlo over seeds, judged against the truth and the bound."""

from __future__ import annotations

import csv
import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from coopenv.estimation.bound import cramer_rao
from coopenv.estimation.metrics import json_ready, settling_time
from coopenv.estimation.observers.registry import find
from coopenv.estimation.observers.runner import record, run
from coopenv.runs.output import writing
from coopenv.scenario import Scenario

LEADERBOARD_FILES = ("leaderboard.json", "leaderboard.csv")

SETTLED_POSITION, SETTLED_ORIENTATION = 0.5, 5.0
"""m and deg below which a vehicle counts as settled under noise."""


@dataclass(frozen=True)
class Row:
    """One observer and one vehicle, over all seeds."""

    environment: str
    observer: str
    vehicle: str
    position_rmse_m: float
    """Root of the mean over seeds of the squared RMSE in the steady state; NaN when a run failed."""
    orientation_rmse_deg: float
    bound_m: float
    """Joint posterior Cramér-Rao bound with the visibility that came about."""
    anees: float
    """Mean NEES / 6 in the steady state; 1 for an honest covariance."""
    settled_fraction: float
    settle_time_s: float
    """Median over the seeds that settled."""
    bytes_per_s: float
    us_per_update: float
    failure: str
    """Who failed first, when and why; empty where nobody did."""


@dataclass(frozen=True)
class Sample:
    """One observer on one seed; arrays (N,)."""

    observer: str
    position_mse: np.ndarray
    orientation_mse: np.ndarray
    bound_mse: np.ndarray
    anees: np.ndarray
    settle_time: np.ndarray
    bytes_per_s: np.ndarray
    us_per_update: np.ndarray
    failure: str


def judge_seed(scenario: Scenario, seed: int, observers: Sequence[str], steady_from: float) -> list[Sample]:
    """Record one world and run every observer on the record."""
    recording = record(scenario, seed)
    bound = cramer_rao(recording).position_rms(steady_from) ** 2
    steady = recording.t > steady_from
    samples = []
    for name in observers:
        result = run(name, recording)
        samples.append(
            Sample(
                name,
                (result.position_error[steady] ** 2).mean(axis=0),
                (result.orientation_error[steady] ** 2).mean(axis=0),
                bound,
                result.anees(steady_from),
                settling_time(
                    result.t,
                    result.position_error,
                    result.orientation_error,
                    SETTLED_POSITION,
                    SETTLED_ORIENTATION,
                ),
                result.bytes_per_second,
                result.microseconds_per_update,
                result.failure,
            )
        )
    return samples


def compare(
    scenario: Scenario,
    environment: str,
    observers: Sequence[str],
    seeds: int,
    steady_from: float,
    jobs: int = 1,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Row]:
    """Judge observers over seeds 0, 1, ...; processes share the seeds, and the result does not depend on how many.

    Raises:
        CoopenvError: an unknown observer.
    """
    for name in observers:
        find(name)
    by_seed: dict[int, list[Sample]] = {}
    if jobs == 1:
        for seed in range(seeds):
            by_seed[seed] = judge_seed(scenario, seed, observers, steady_from)
            on_progress((seed + 1) / seeds)
    else:
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            work = {pool.submit(judge_seed, scenario, s, observers, steady_from): s for s in range(seeds)}
            for done in as_completed(work):
                by_seed[work[done]] = done.result()
                on_progress(len(by_seed) / seeds)
    samples = [sample for seed in range(seeds) for sample in by_seed[seed]]
    return [
        row_of(environment, name, vehicle, i, [s for s in samples if s.observer == name])
        for name in observers
        for i, vehicle in enumerate(scenario.vehicle_names)
    ]


def row_of(environment: str, observer: str, vehicle: str, i: int, samples: Sequence[Sample]) -> Row:
    """Sum up one vehicle of one observer over seeds."""
    times = np.array([s.settle_time[i] for s in samples])
    settled = times[np.isfinite(times)]
    return Row(
        environment,
        observer,
        vehicle,
        float(np.sqrt(np.mean([s.position_mse[i] for s in samples]))),
        float(np.sqrt(np.mean([s.orientation_mse[i] for s in samples]))),
        float(np.sqrt(np.mean([s.bound_mse[i] for s in samples]))),
        float(np.mean([s.anees[i] for s in samples])),
        len(settled) / len(times),
        float(np.median(settled)) if len(settled) else float("nan"),
        float(np.mean([s.bytes_per_s[i] for s in samples])),
        float(np.median([s.us_per_update[i] for s in samples])),
        next((s.failure for s in samples if s.failure), ""),
    )


def write_leaderboard(rows: Sequence[Row], folder: Path, command: str) -> list[Path]:
    """Write `leaderboard.json` (with the command) and `leaderboard.csv`; there is at least one row.

    Raises:
        OutputError: the folder cannot be written.
    """
    plain = [json_ready(asdict(row)) for row in rows]
    as_json, as_csv = (folder / name for name in LEADERBOARD_FILES)
    with writing(as_json):
        folder.mkdir(parents=True, exist_ok=True)
        as_json.write_text(json.dumps({"command": command, "rows": plain}, indent=1) + "\n", encoding="utf-8")
        with as_csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(plain[0]))
            writer.writeheader()
            writer.writerows(plain)
    return [as_json, as_csv]
