"""What a recorded run comes to: the figures of `metrics.json`, one dict per vehicle and one for the run."""

import math
from collections.abc import Mapping
from platform import python_version
from typing import Any

import numpy as np
import warp as wp

from coopenv.api.arguments import outcome_words
from coopenv.base.installation import version
from coopenv.estimation.metrics import CONVERGED, observability_of, summarise
from coopenv.estimation.observability import ConvergenceRates, Observability, convergence_rates, least_mean
from coopenv.estimation.outcomes import Outcome
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.rollouts import Ending, Rollout

RATES = (
    "guaranteed_rate_per_s",
    "guaranteed_rate_at_s",
    "frozen_rate_per_s",
    "frozen_rate_window_per_s",
    "frozen_rate_window_from_s",
)
"""Keys of the rates that theory tells."""

CARRIED_FOR = 1.0  # s at least, that an estimate is known for, before odometry is said to carry it


def vehicle_metrics(
    trajectory: Trajectory,
    observability: Observability,
    endings: list[Ending],
    steady_from: float,
    rates: ConvergenceRates | None = None,
) -> list[dict[str, Any]]:
    """Return one dict per vehicle: outcome, errors, rates, consistency and observability, units in the keys.

    What a vehicle did after it had arrived or collided, parked, does not count. `rates` are those of the paper's
    observer, of others there are none.
    """
    ends = [ending.time for ending in endings]
    return [
        {
            **summary,
            **rate_metrics(rates, i, ends[i]),
            "outcome": endings[i].outcome,
            "ended_at_s": np.nan if endings[i].outcome == Outcome.UNDER_WAY.words else endings[i].time,
            "observability": observability_metrics(observability_of(observability, i, ends[i]), trajectory, i),
        }
        for i, summary in enumerate(summarise(trajectory, steady_from, ends))
    ]


def theory_rates(run: Rollout, trajectory: Trajectory) -> ConvergenceRates | None:
    """Return the rates of the paper's observer along the record of a run; None where another one runs."""
    if run.scenario.observer.name != "riccati":
        return None
    setups = [run.engine.world.briefing.setups[i] for i in run.vehicles]
    gains = setups[0].gains
    return convergence_rates(trajectory, [setup.gains.k for setup in setups], gains.q, gains.V, gains.P0)


def rate_metrics(rates: ConvergenceRates | None, vehicle: int, end: float) -> dict[str, Any]:
    """Return the guaranteed rate of one vehicle up to its end, s, the frozen one, and when they are least."""
    if rates is None:
        return dict.fromkeys(RATES, math.nan)
    live = ~(rates.t > end + 1e-6)
    t, guaranteed, frozen = rates.t[live], rates.guaranteed[live, vehicle], rates.frozen[live, vehicle]
    least = int(np.argmin(guaranteed))
    figures = (guaranteed[least], t[least], frozen.min(), *least_mean(t, frozen))
    return {key: float(figure) for key, figure in zip(RATES, figures, strict=True)}


def observability_metrics(observability: Observability, trajectory: Trajectory, vehicle: int) -> dict[str, Any]:
    """Return the verdicts on the windows of one vehicle (see `observability_of`) and the figures of its Gramian.

    A vehicle that bearings alone do not make observable may still be known: after it was last off, odometry carries it.
    NaN where there is no window.
    """
    smallest, local, verdict = observability.min_eigenvalue, observability.local_eigenvalue, observability.observable
    some = len(verdict) > 0
    gaps = [(interval.start, interval.end) for interval in observability.intervals(0) if not interval.observable]
    known = CONVERGED.contains(trajectory.position_error[:, vehicle], trajectory.orientation_error[:, vehicle])
    parts = [_parts(gap, trajectory.t, known) for gap in gaps]
    return {
        "window_s": observability.window,
        "threshold": observability.threshold,
        "share_observable": float(verdict.mean()) if some else np.nan,
        "not_observable_s": [part for part, _ in parts if part],
        "carried_by_odometry_s": [part for _, part in parts if part],
        "gramian_min_eigenvalue_min": float(smallest.min()) if some else np.nan,
        "gramian_min_eigenvalue_median": float(np.median(smallest)) if some else np.nan,
        "gramian_condition_number_median": float(np.median(observability.condition_number)) if some else np.nan,
        "local_eigenvalue_min": float(local.min()) if some else np.nan,
        "local_eigenvalue_median": float(np.median(local)) if some else np.nan,
    }


def _parts(gap: tuple[float, float], t: np.ndarray, known: np.ndarray) -> tuple[list[float], list[float]]:
    """Return where in a gap (s) a vehicle was not known, and where from then on it was; empty where that is nowhere."""
    start, end = gap
    off = t[(t >= start - 1e-9) & (t <= end + 1e-9) & ~known]
    if not len(off):
        return [], [start, end]
    last = float(off[-1])
    carried = [last, end] if end - last > CARRIED_FOR else []
    return ([start, last] if carried else [start, end]), carried


def outcome_line(run: Rollout) -> str:
    """Return how the run ended, in words."""
    outcomes = [ending.outcome for ending in run.endings()]
    counts = {word: outcomes.count(word) for word in outcome_words(run.scenario)[1:]}
    parts = [f"{count} {word}" for word, count in counts.items() if count]
    time = run.ticks_recorded / run.scenario.rates.camera
    if Outcome.UNDER_WAY.words not in outcomes:
        own = "" if len(outcomes) == len(run.scenario.vehicles) else " estimated here"
        end = f"all vehicles{own} had ended by {max(ending.time for ending in run.endings()):.4g} s"
    elif run.ticks_recorded >= run.scenario.horizon_ticks:
        end = f"horizon reached at {time:g} s"
    elif run.ticks_recorded < run.ticks_planned:
        end = f"ended before its time, at {time:g} s"
    else:
        end = f"stopped after the steps asked for, at {time:g} s"
    return f"{end} ({', '.join(parts)})" if parts else end


def run_metrics(
    name: str, overrides: Mapping[str, Any], run: Rollout, vehicles: list[dict[str, Any]], steady_from: float
) -> dict[str, Any]:
    """Return the contents of `metrics.json`."""
    simulated = run.ticks_recorded / run.scenario.rates.camera
    return {
        "environment": name,
        "title": run.scenario.title,
        "seed": run.seed,
        "overrides": dict(overrides),
        "policy": run.policy_name,
        "observer": run.scenario.observer.name,
        "dtype": run.engine.world.precision.name,
        "device": run.engine.world.device,
        "versions": {"coopenv": version(), "warp": wp.__version__, "numpy": np.__version__, "python": python_version()},
        "outcome": outcome_line(run),
        "simulated_time_s": simulated,
        "wall_time_s": run.wall_time,
        "real_time_factor": simulated / run.wall_time,
        "steady_from_s": steady_from,
        "vehicles": vehicles,
    }
