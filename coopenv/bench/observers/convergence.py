"""Convergence: over many seeds of a scenario, and from many initial estimates on one record (basins of attraction).

Of initial estimates the attitude is uniform over SO(3), the position uniform in a ball.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.format import fixed
from coopenv.bench.executors import Executor
from coopenv.bench.observers.sources import RecordSource
from coopenv.episode import Views
from coopenv.estimation import UNIFORM_ROTATION
from coopenv.estimation.metrics import CONVERGED, SETTLED, Interval, settling_time, wilson_interval
from coopenv.evaluation.episodes import play
from coopenv.observers.contract import Factory
from coopenv.observers.recording import Recording
from coopenv.observers.registry import portable
from coopenv.observers.runner import run
from coopenv.report.table import Table
from coopenv.scenario import Scenario

RADIUS = 15.0  # m
ANGLE_BINS = tuple(range(0, 181, 30))  # deg


@dataclass(frozen=True)
class Draw:
    """Result of one vehicle from one draw of the initial estimates: a line of `basin.csv`."""

    draw: int
    observer: str
    vehicle: str
    initial_orientation_error_deg: float
    initial_position_error_m: float
    converged: bool
    """True if the vehicle's final error is within CONVERGED."""
    convergence_time_s: float
    """Time (s) from which the errors stay within CONVERGED; NaN if they do not."""
    final_position_error_m: float
    final_orientation_error_deg: float
    failure: str


@dataclass(frozen=True)
class Basin:
    """Number of draws that converge."""

    environment: str
    observer: str
    draws: int
    converged_fraction: float
    """Share of the draws in which every vehicle ends converged."""
    interval: Interval
    """95 %, Wilson."""
    by_vehicle: tuple[float, ...]
    convergence_time_s: float
    """Median over the draws that converge of the time at which the last vehicle has converged."""
    failed: int
    """Draws in which the observer failed; they count as not converged."""
    failure: str
    """The vehicle that failed in the first of them, when and why; empty where there is none."""


def random_start(recording: Recording, seed: int) -> Recording:
    """Return the record with attitudes uniform over SO(3) and positions uniform in a ball about the true ones.

    The covariance is that of these distributions: (pi^2 / 3 + 2) / 3 rad^2 and RADIUS^2 / 5 per axis.
    """
    generator = np.random.default_rng([seed, 3])
    N = len(recording.setups)
    direction = generator.normal(size=(N, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = RADIUS * generator.random((N, 1)) ** (1 / 3)
    rotations = np.array(Rotation.random(N, generator).as_matrix())
    covariance = np.diag(np.repeat([UNIFORM_ROTATION, RADIUS**2 / 5.0], 3))
    return replace(
        recording,
        start_rotation=rotations,
        start_position=recording.truth.position[0] + distance * direction,
        start_covariance=np.tile(covariance, (N, 1, 1)),
    )


def draw_starts(source: RecordSource, observers: Mapping[str, str | Factory], draw: int) -> list[Draw]:
    """Run every observer from one draw of the initial estimates."""
    started, found = random_start(source.recording(source.usual[0], 0), draw), []
    for name, factory in observers.items():
        result = run(factory, started)
        angle, distance = result.orientation_error, result.position_error
        times = settling_time(result.t, distance, angle, CONVERGED)
        converged = CONVERGED.contains(distance[-1], angle[-1])
        found += [
            Draw(
                *(draw, name, setup.name, float(angle[0, i]), float(distance[0, i]), bool(converged[i])),
                *(float(times[i]), float(distance[-1, i]), float(angle[-1, i]), result.failure),
            )
            for i, setup in enumerate(started.setups)
        ]
    return found


def check_source(source: RecordSource) -> None:
    """Refuse a source on which basins cannot be studied."""
    if not source.seeded:
        raise CoopenvError(f"--basin: {source.name} is recorded; basins are studied in simulated environments")


def study_basin(
    source: RecordSource,
    observers: Sequence[str],
    draws: int,
    executor: Executor,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[Draw]:
    """Return the draws 0, 1, ... of every observer, on the record of seed 0.

    Raises:
        CoopenvError: an unknown observer, or a source whose geometry is not the question.
    """
    check_source(source)
    sent = {name: portable(name) for name in observers}
    found = executor.map(partial(draw_starts, source, sent), range(draws), lambda done: on_progress(done / draws))
    return [draw for name in observers for part in found for draw in part if draw.observer == name]


def basins_of(environment: str, draws: Sequence[Draw]) -> list[Basin]:
    """Sum up draws by observer."""
    basins = []
    for name in dict.fromkeys(draw.observer for draw in draws):
        own = [draw for draw in draws if draw.observer == name]
        vehicles = len({draw.vehicle for draw in own})
        converged = np.array([draw.converged for draw in own]).reshape(-1, vehicles)
        times = np.array([draw.convergence_time_s for draw in own]).reshape(-1, vehicles)
        successes = converged.all(axis=1)
        failures = [draw.failure for draw in own[::vehicles] if draw.failure]
        basins.append(
            Basin(
                environment=environment,
                observer=name,
                draws=len(converged),
                converged_fraction=float(successes.mean()),
                interval=wilson_interval(int(successes.sum()), len(converged)),
                by_vehicle=tuple(converged.mean(axis=0).tolist()),
                convergence_time_s=float(np.median(times[successes].max(axis=1))) if successes.any() else math.nan,
                failed=len(failures),
                failure=next(iter(failures), ""),
            )
        )
    return basins


def basin_table(basins: Sequence[Basin]) -> Table:
    """Return the number of draws that converge, one line per observer."""
    numbers = ["draws", "failed", "all vehicles\nconverge", "95 %", "converged [s]\nmedian"]
    table = Table.of_texts(["basin"], numbers, gap=0)
    for basin in basins:
        low, high = (100 * end for end in basin.interval)
        table.add(
            basin.observer,
            str(basin.draws),
            str(basin.failed),
            f"{100 * basin.converged_fraction:.1f} %",
            f"{low:.1f}..{high:.1f} %",
            fixed(basin.convergence_time_s, 1),
        )
    return table


def basin_failures(basins: Sequence[Basin]) -> list[str]:
    """Return one line per observer that failed from some of the initial estimates."""
    return [
        f"{basin.observer} (basin): failed in {basin.failed} of {basin.draws} draws, first {basin.failure}"
        for basin in basins
        if basin.failed
    ]


def by_angle(draws: Sequence[Draw]) -> list[tuple[int, int]]:
    """Return (converged, all) vehicles in each bin of `ANGLE_BINS` of their own initial angle."""
    angle = np.array([draw.initial_orientation_error_deg for draw in draws])
    converged = np.array([draw.converged for draw in draws], bool)
    counts = (np.histogram(some, ANGLE_BINS)[0].tolist() for some in (angle[converged], angle))
    return list(zip(*counts, strict=True))


@dataclass(frozen=True)
class SeedStudy:
    """Results of a scenario's own observer over many seeds, per seed (S) and vehicle (N)."""

    vehicles: list[str]
    seeds: list[int]
    steady_from: float
    """s"""
    position_rmse_m: np.ndarray
    """Over t > steady_from."""
    orientation_rmse_deg: np.ndarray
    settle_time_s: np.ndarray
    """After which the errors stay within SETTLED; NaN: never."""
    final_position_error_m: np.ndarray
    final_orientation_error_deg: np.ndarray

    def document(self, environment: str) -> dict[str, Any]:
        """Return the output of `bench seeds --json`: per vehicle, one figure per seed."""
        figures = {name: values for name, values in vars(self).items() if isinstance(values, np.ndarray)}
        return {
            "environment": environment,
            "seeds": self.seeds,
            "steady_from_s": self.steady_from,
            "settled_below": SETTLED._asdict(),
            "vehicles": [
                {"vehicle": vehicle, **{name: values[:, i] for name, values in figures.items()}}
                for i, vehicle in enumerate(self.vehicles)
            ],
        }


def study_seeds(
    scenario: Scenario, seeds: range, steady_from: float, on_progress: Callable[[float], None] = lambda share: None
) -> SeedStudy:
    """Run one world per seed, all at once, with action zero, and judge every camera tick; `steady_from` in s."""
    engine, ticks = Engine(scenario, len(seeds), "float64"), scenario.horizon_ticks
    views = Views(engine, ("position_error", "orientation_error"))
    for tick in play(engine, seeds, ticks):
        views.take()
        if tick % 100 == 0:
            on_progress(tick / ticks)
    position, orientation = views["position_error"], views["orientation_error"]
    t = np.arange(ticks + 1) / scenario.rates.camera
    steady = t > steady_from
    return SeedStudy(
        vehicles=scenario.vehicle_names,
        seeds=list(seeds),
        steady_from=steady_from,
        position_rmse_m=np.sqrt((position[steady] ** 2).mean(axis=0)),
        orientation_rmse_deg=np.sqrt((orientation[steady] ** 2).mean(axis=0)),
        settle_time_s=settling_time(t, position, orientation, SETTLED),
        final_position_error_m=position[-1],
        final_orientation_error_deg=orientation[-1],
    )


def seed_table(study: SeedStudy) -> Table:
    """Return one row per vehicle: settled seeds, settling time, steady RMSE as mean, spread and worst."""
    rmse = ("position RMSE [m]\nmean±std (worst)", "orientation [deg]\nmean±std (worst)")
    table = Table.of_texts(("vehicle",), ("settled\nseeds", "settles at [s]\nmedian (last)", *rmse))
    for i, vehicle in enumerate(study.vehicles):
        times = study.settle_time_s[:, i]
        settled = times[np.isfinite(times)]
        table.add(
            vehicle,
            f"{len(settled)}/{len(times)}",
            f"{np.median(settled):.1f} ({settled.max():.1f})" if len(settled) else "-",
            _spread(study.position_rmse_m[:, i], 4),
            _spread(study.orientation_rmse_deg[:, i], 2),
        )
    return table


def _spread(values: np.ndarray, digits: int) -> str:
    return f"{values.mean():.{digits}f}±{values.std():.{digits}f} ({values.max():.{digits}f})"
