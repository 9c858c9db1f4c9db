"""What a recorded run comes to: the figures of `metrics.json`, one dict per vehicle and one for the run."""

from collections.abc import Mapping
from platform import python_version
from typing import Any

import numpy as np
import warp as wp

from coopenv.api.infos import outcome_words
from coopenv.estimation.metrics import observability_of, summarise
from coopenv.estimation.observability import Observability
from coopenv.estimation.outcomes import Outcome
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.rollouts import Ending, Rollout
from coopenv.shipped import version


def vehicle_metrics(
    trajectory: Trajectory, observability: Observability, endings: list[Ending], steady_from: float
) -> list[dict[str, Any]]:
    """Return one dict per vehicle: outcome, errors, consistency and observability, units in the keys.

    What a vehicle did after it had arrived or collided, parked, does not count.
    """
    ends = [ending.time for ending in endings]
    return [
        {
            **summary,
            "outcome": endings[i].outcome,
            "ended_at_s": np.nan if endings[i].outcome == Outcome.UNDER_WAY.words else endings[i].time,
            "observability": observability_metrics(observability_of(observability, i, ends[i])),
        }
        for i, summary in enumerate(summarise(trajectory, steady_from, ends))
    ]


def observability_metrics(observability: Observability) -> dict[str, Any]:
    """Return the verdicts on the windows of one vehicle (see `observability_of`) and the figures of its Gramian.

    NaN where there is no window.
    """
    smallest, local, verdict = observability.min_eigenvalue, observability.local_eigenvalue, observability.observable
    some = len(verdict) > 0
    gaps = [interval for interval in observability.intervals(0) if not interval.observable]
    return {
        "window_s": observability.window,
        "threshold": observability.threshold,
        "share_observable": float(verdict.mean()) if some else np.nan,
        "not_observable_s": [[gap.start, gap.end] for gap in gaps],
        "gramian_min_eigenvalue_min": float(smallest.min()) if some else np.nan,
        "gramian_min_eigenvalue_median": float(np.median(smallest)) if some else np.nan,
        "gramian_condition_number_median": float(np.median(observability.condition_number)) if some else np.nan,
        "local_eigenvalue_min": float(local.min()) if some else np.nan,
        "local_eigenvalue_median": float(np.median(local)) if some else np.nan,
    }


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
