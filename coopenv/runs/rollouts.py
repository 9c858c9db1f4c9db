"""Episodes with a driver: stepping, recording, and metrics."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from platform import python_version
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from coopenv.api.arguments import outcome_words
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, explained
from coopenv.base.installation import version
from coopenv.episode import OF_TRAJECTORY, RECORDED, Episode, Views
from coopenv.estimation import Outcome
from coopenv.estimation.metrics import CONVERGED, mean_targets_in_view, observability_of, steady_mean, summarise
from coopenv.estimation.observability import ConvergenceRates, Observability, convergence_rates, least_mean
from coopenv.estimation.poses import position_covariance, roll_pitch_yaw_deg
from coopenv.estimation.trajectory import Trajectory
from coopenv.evaluation.episodes import estimated_here, play
from coopenv.policies import Policy, load_policy
from coopenv.runs.recorder import source_of
from coopenv.scenario import Scenario, ScenarioLike, load_scenario
from coopenv.sources.base import EPISODE_OVER, Backend


class Ending(NamedTuple):
    """End of a vehicle's run: outcome in the words of infos, and time, s (`under way`: the end of the record)."""

    outcome: str
    time: float


class Rollout:
    """One world, its policy, and all that has been recorded so far."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int = 0,
        steps: int | None = None,
        dtype: str = "float64",
        device: str = "cpu",
        policy: str | Policy = "zero",
        backend: Backend | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Build the world; arguments as for `rollout`, without the arguments of its ticks.

        `backend` is where they come from (None: simulated), and `options` those of its reset.
        """
        if steps is not None and steps < 1:
            raise CoopenvError(f"steps must be at least 1, got {steps}")
        self.engine = Engine(scenario, 1, dtype, device, backend=backend)
        self.scenario, self.seed = self.engine.backend.scenario, seed
        self.policy = load_policy(policy, scenario, seed)
        self.policy_name = policy if isinstance(policy, str) else getattr(policy, "__name__", "custom")
        if self.engine.backend.capabilities.recorded:  # the driver of the recording
            self.policy_name = "recorded"
        self.ticks_planned = scenario.horizon_ticks
        if steps is not None:
            self.ticks_planned = min(self.ticks_planned, steps * scenario.ticks_per_decision)
        self.wall_time = 0.0
        self._options = options
        self._views = Views(self.engine)

    @property
    def vehicles(self) -> tuple[int, ...]:
        """The vehicles that are estimated here, which tables and figures of errors are about."""
        return estimated_here(self.engine)

    @property
    def ticks_recorded(self) -> int:
        """Camera ticks since t = 0 that have been recorded."""
        return max(0, self._views.taken - 1)

    def play(self, fields: Sequence[str] = RECORDED) -> Iterator[int]:
        """Start the episode and yield the number of each camera tick, from 0, once its fields are recorded.

        The run ends at the horizon, after `steps` decisions, or with the decision in which the last vehicle that is
        estimated here ended.
        `wall_time` (s) counts what is spent in here, not what the caller does between two ticks.

        Raises:
            CoopenvError: an estimate is not finite.
        """
        start = perf_counter()
        self._views = Views(self.engine, fields)
        self.wall_time = 0.0
        moments = play(self.engine, [self.seed], self.ticks_planned, self.policy, False, self._options)
        for tick in moments:
            self._views.take()
            self._check_estimates(tick)
            self.wall_time += perf_counter() - start
            yield tick
            start = perf_counter()
        if self.engine.backend.capabilities.real_time:
            self.engine.backend.stop(EPISODE_OVER)

    def _check_estimates(self, tick: int) -> None:
        R, p = (self.engine.view(name)[0] for name in ("estimate_rotation", "estimate_position"))
        lost = [i for i in self.vehicles if not (np.isfinite(R[i]).all() and np.isfinite(p[i]).all())]
        if lost:
            name, vehicle = self.scenario.observer.name, self.scenario.vehicle_names[lost[0]]
            time = tick / self.scenario.rates.camera
            raise CoopenvError(f"observer '{name}' at {vehicle} at {time:.3f} s: its estimate is not finite")

    def episode(self, name: str = "") -> Episode:
        """Return the record so far, of what has a name; `play` must have yielded at least once."""
        return self._views.episode(self.scenario, source_of(self.engine, name, self.seed, self.policy_name))

    def trajectory(self) -> Trajectory:
        """Return the trajectories so far; `play` must have yielded at least once."""
        return self.episode().trajectory

    def endings(self, vehicles: Sequence[int] | None = None) -> list[Ending]:
        """Return the end of each vehicle's run so far (None: of the vehicles that are estimated here)."""
        ended = self._views["ended"][:, 0][:, [*(self.vehicles if vehicles is None else vehicles)]]
        first = np.where(ended.any(axis=0), np.argmax(ended != 0, axis=0), len(ended) - 1)
        words, times = outcome_words(self.scenario), (first / self.scenario.rates.camera).tolist()
        return [Ending(words[outcome], time) for outcome, time in zip(ended[-1].tolist(), times, strict=True)]


@explained
def rollout(
    scenario: ScenarioLike,
    seed: int = 0,
    steps: int | None = None,
    dtype: str = "float64",
    device: str = "cpu",
    policy: str | Policy = "zero",
    on_tick: Callable[[Engine, int], None] | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
) -> Trajectory:
    """Run one episode and return its record, every camera tick from t = 0.

        trajectory = rollout(coopenv.load_scenario("busy_intersection"), seed=3)

    Args:
        scenario: the world, as for `coopenv.load_scenario`: name, TOML file, dict or scenario.
        seed: of all that is drawn: starts, noise, losses, and the actions of the policy "random".
        steps: decisions (None: up to the horizon, where a run ends in any case).
        dtype: "float32" or "float64".
        device: "cpu" or a CUDA device.
        policy: "zero", "random", or what `find_agent` takes, such as a function of the observations (N, D) that returns
            actions (N, A); vehicles with prescribed motion ignore their actions.
        on_tick: called with the engine and the tick's number after every tick, 0 included.
        overrides: dotted scenario keys.

    Raises:
        CoopenvError: an argument is not valid.
    """
    run = Rollout(load_scenario(scenario, overrides), seed, steps, dtype, device, policy)
    for tick in run.play(OF_TRAJECTORY):
        if on_tick is not None:
            on_tick(run.engine, tick)
    return run.trajectory()


RATES = (
    "guaranteed_rate_per_s",
    "guaranteed_rate_at_s",
    "frozen_rate_per_s",
    "frozen_rate_window_per_s",
    "frozen_rate_window_from_s",
)
"""Keys of the rates that theory predicts."""

CARRIED_FOR = 1.0  # s at least, that an estimate is known for, before it counts as carried by odometry


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


def estimates(trajectory: Trajectory, steady_from: float, covariance: bool) -> list[dict[str, Any]]:
    """Return one dict per vehicle without true poses: what its observer says, units in the keys.

    Standard deviations are roots of traces, of the position in the map frame and of the small rotation 2 lambda, and
    means over the ticks after `steady_from`, s. They are NaN where P is a matrix of gains, and so no `covariance`.
    """
    P = position_covariance(trajectory.rotation_estimate, trajectory.position_estimate, trajectory.covariance)
    traces = (np.trace(part, axis1=-2, axis2=-1) for part in (P, trajectory.covariance[..., :3, :3]))
    stds = [steady_mean(trajectory.t, np.sqrt(trace), steady_from) for trace in traces]
    position, orientation = (std if covariance else np.full(std.shape, np.nan) for std in stds)
    yaw = roll_pitch_yaw_deg(trajectory.rotation_estimate[-1])[:, 2]
    return [
        {
            "vehicle": name,
            "position_std_m": float(position[i]),
            "orientation_std_deg": math.degrees(orientation[i]),
            "mean_targets_in_view": float(mean_targets_in_view(trajectory.visible[:, i])),
            "final_position_estimate_m": trajectory.position_estimate[-1, i].tolist(),
            "final_yaw_estimate_deg": float(yaw[i]),
        }
        for i, name in enumerate(trajectory.vehicles.tolist())
    ]


def theory_rates(run: Rollout, trajectory: Trajectory) -> ConvergenceRates | None:
    """Return the rates of the paper's observer along the record of a run; None where another one runs."""
    if run.scenario.observer.name != "riccati":
        return None
    names = run.scenario.vehicle_names
    setups = [run.engine.world.observer_init.setups[names.index(name)] for name in trajectory.vehicles.tolist()]
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
    """Return the parts of a gap (s) in which a vehicle is unknown, and known again; empty without such parts."""
    start, end = gap
    off = t[(t >= start - 1e-9) & (t <= end + 1e-9) & ~known]
    if not len(off):
        return [], [start, end]
    last = float(off[-1])
    carried = [last, end] if end - last > CARRIED_FOR else []
    return ([start, last] if carried else [start, end]), carried


def outcome_line(run: Rollout) -> str:
    """Return the end of the run, in words."""
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
    name: str,
    overrides: Mapping[str, Any],
    run: Rollout,
    vehicles: list[dict[str, Any]],
    steady_from: float,
    without_truth: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Return the contents of `metrics.json`: `vehicles` are rows of `vehicle_metrics`, the others of `estimates`."""
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
        "ticks": run.ticks_recorded,
        "missing_ticks": {run.scenario.vehicle_names[i]: int(run.engine.world.missing_in_all[i]) for i in run.vehicles},
        "simulated_time_s": simulated,
        "wall_time_s": run.wall_time,
        "real_time_factor": simulated / run.wall_time,
        "steady_from_s": steady_from,
        "vehicles": vehicles,
        "without_truth": [*without_truth],
    }
