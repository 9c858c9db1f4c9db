"""`coopenv svea demo`: an experiment of the laboratory with fake cars, from their start to the figures."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from rich.console import Console

from coopenv.base.errors import CoopenvError, check_one_of, listed
from coopenv.base.files import replacing_file, writing
from coopenv.base.format import seconds
from coopenv.base.installation import data_directory
from coopenv.base.interrupts import also_kept
from coopenv.cars.backend.backend import Svea, open_svea
from coopenv.cars.fake.fleet import fakes
from coopenv.cars.fake.lockstep import LockstepFakes
from coopenv.cars.link.zenoh import library
from coopenv.cars.settings.profile import Role
from coopenv.estimation.metrics import live_ticks, summarise
from coopenv.report.table import Table
from coopenv.runs.command import execute, report
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.rollouts import Rollout
from coopenv.scenario import Scenario

STEADY_FROM = 2.0
"""s: cars know their places by then."""


def links_line(backend: Svea) -> str:
    """Return the state of the links in a few words, for a line that is shown while it runs."""
    parts = [
        f"{notes['name']} {notes['gate']}" + (f", {here + there} refused" if here + there else "")
        for notes, here, there in _links(backend)
    ]
    late = f"; {backend.pacer.missed} deadlines missed" if backend.pacer.missed else ""
    return "; ".join(parts) + late


def _links(backend: Svea) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Yield the notes of each car driven here, and how many messages were refused here and by its gate."""
    for vehicle in backend.binding.local:
        notes = backend.notes(vehicle)
        yield notes, sum(backend.intake.rejected[notes["name"]].values()), sum(notes["gate_rejections"].values())


def kept_drive(path: Path | None, backend: Svea) -> str:
    """Return a line on the record of an interrupted drive; empty if there is nothing to replay."""
    if path is None or backend.recorder is None or not backend.recorder.begun:
        return ""
    return f"kept: {path}, the drive up to here: coopenv run {quote(str(path))}"


def links_report(backend: Svea, out: Console) -> None:
    """Print a table with a row per car, and a line on time and on why it ended."""
    health = backend.health
    table = Table.of_texts(("car", "gate"), ("clock offset", "messages refused", "gate refused"), title="Links")
    for notes, here, there in _links(backend):
        table.add(notes["name"], notes["gate"], f"{1e3 * notes['clock_offset']:.1f} ms", str(here), str(there))
    out.print(table)
    late = 1e3 * backend.pacer.late(0.99)
    out.print(
        f"{health.received} messages, {health.ticks} ticks, {backend.pacer.missed} missed deadlines, "
        f"wake-up lateness p99 {late:.2f} ms",
        soft_wrap=True,
    )
    if left_out := [f"{name} {count}" for name, count in backend.refused.items() if count]:
        out.print(f"Left out: {', '.join(left_out)}", soft_wrap=True)
    if backend.watchdog.trip is not None:
        out.print(f"Stopped: {backend.watchdog.trip.reason}", soft_wrap=True)


def check_alive(backend: Svea) -> None:
    """Raise CoopenvError: nothing has come from any car."""
    if not backend.health.received:
        names, where = listed(list(backend.binding.cars)), ", ".join(backend.deployment.network.connect)
        raise CoopenvError(
            f"nothing has come from {names} by {where}: are they on, and are their names fleet/NAME/...?"
        )


def truth_report(backend: Svea) -> str:
    """Return why true poses are missing, by topic of motion capture what came."""
    names, lead = list(backend.binding.cars), "without true poses there are no errors to show: "
    if not backend.capabilities.truth:
        return f"{lead}sensors.truth = false"
    topics = [backend.binding.profile.topic_of(name, Role.TRUTH) for name in names]
    came = [topic for topic in topics if isfinite(backend.station.silence(topic))]
    silent = [topic for topic in topics if topic not in came]
    parts = [f"nothing came on {listed(silent)}"] if silent else []
    parts += [f"messages on {listed(came)} came too late for the ticks"] if came else []
    return lead + "; ".join(parts)


Rows = list[dict[str, Any]]
"""Figures of an episode, a dict per vehicle."""


def judged(run: Rollout) -> Rows:
    """Return the figures of an episode that is over, of vehicles whose true poses are known."""
    whole = run.trajectory()
    vehicles = whole.with_truth(run.vehicles)
    trajectory = whole.of_vehicles(vehicles).where_truth_is_known()
    ends = [ending.time for ending in run.endings(vehicles)]
    rows = summarise(trajectory, STEADY_FROM, ends)
    static = ~trajectory.target_moving[: len(run.scenario.landmarks)]
    for vehicle, ticks in enumerate(live_ticks(trajectory.t, len(rows), ends)):
        seen = trajectory.visible[1:ticks, vehicle, : len(static)][:, static]
        rows[vehicle]["hidden_share"] = float(1.0 - seen.all(axis=-1).mean()) if len(seen) else np.nan
    return rows


MEANS = (("steady_position_rmse_m", 1, 4), ("steady_orientation_rmse_deg", 1, 2), ("hidden_share", 100, 1))
"""Figures of the table side by side: key, factor, digits."""


def side_by_side(vehicles: list[str], backends: Mapping[str, list[Rows]]) -> Table:
    """Return a row per vehicle and backend, of all episodes: the last settling; means with standard errors."""
    headings = ("\nseeds", "settles\nby [s]", "RMSE [m]\nmean±SE", "RMSE [deg]\nmean±SE", "hidden [%]\nmean±SE")
    table = Table.of_texts(("\nvehicle", "\non"), headings)
    for i, vehicle in enumerate(vehicles):
        for name, episodes in backends.items():
            settled = float(np.max([rows[i]["settle_time_s"] for rows in episodes]))  # NaN where one never does
            means = [_mean([factor * rows[i][key] for rows in episodes], digits) for key, factor, digits in MEANS]
            table.add(vehicle, name, str(len(episodes)), *seconds([settled]), *means)
    return table


def _mean(values: list[float], digits: int) -> str:
    """Return mean and standard error in words; the latter needs two values."""
    error = f"±{np.std(values, ddof=1) / np.sqrt(len(values)):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


FLEETS = {"svea_overtaking": "overtaking.toml", "svea_crossing": "crossing.toml"}
"""Deployment files of the experiments, in `examples/fleet`."""


@dataclass
class Demo:
    """An experiment, its options, and how well time was kept in it."""

    environment: str
    out: Path
    policy: str = "route_follower"
    seed: int = 0
    overrides: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    """Further seeds are driven until the cars have driven so long, s."""
    beside: bool = False
    """Simulate the same seeds, too, and show them beside."""
    deployment: Path | None = None
    """One's own deployment file, whose cars are fakes; `environment` is its environment then."""
    real_time: bool = False
    """Run a router and a process per car in real time, and not all in this one on a simulated clock."""
    time: float = field(default=0.0, init=False)
    """Driven time, s."""
    decisions: int = field(default=0, init=False)
    missed: int = field(default=0, init=False)
    delays: list[float] = field(default_factory=list, init=False)
    """s, of each tick."""

    @property
    def fleet(self) -> Path:
        """Deployment file of the demo. Raises CoopenvError: the environment has none."""
        if self.deployment is not None:
            return self.deployment
        check_one_of("--environment: no fleet of fakes for", self.environment, FLEETS)
        return data_directory("examples/fleet") / FLEETS[self.environment]

    def run(self, port: int | None, log: Console, out: Console) -> bool:
        """Start everything, drive, report, and end everything. Return whether the cars drove without being stopped.

        Of a drive that is interrupted what has been driven takes its place, unless an earlier drive stands there.

        Args:
            port: of the router in real time (None: a free one).
            log: progress.
            out: results.

        Raises:
            CoopenvError: the extra is missing, a process does not start, the cars cannot be armed, results cannot be
                written, or no true poses are known; the drive is kept in the last case.
        """
        if port is not None and not self.real_time:
            raise CoopenvError("--port: cars on a simulated clock have no router; give --real-time, too")
        library()
        fleet, drive = self.fleet, self.out.with_name(f"{self.out.name}.mcap")
        driven: list[Rows] = []
        no_truth, interrupted = None, False
        with writing(drive.parent):
            drive.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            with compile_notice(log), Progress(log, "starting fake cars"):
                station: Callable[..., Svea]
                if self.real_time:
                    station = partial(open_svea, fleet, connect=stack.enter_context(fakes(fleet, port, self.seed)))
                else:
                    station = LockstepFakes(fleet, self.seed).station
            record = stack.enter_context(replacing_file(drive))
            environment = None if self.deployment else self.environment
            backend = station(environment, overrides=self.overrides, record=record)
            stack.callback(backend.close)
            try:
                if not self._drive(backend, driven, log, out) and backend.capabilities.truth:
                    no_truth = CoopenvError(f"{self.environment}: {truth_report(backend)}")
            except KeyboardInterrupt:
                if drive.exists() or backend.recorder is None or not backend.recorder.begun:
                    raise
                also_kept(lambda: f"the drive up to here: coopenv run {quote(str(drive))}" if drive.exists() else "")
                interrupted = True
        if interrupted:
            raise KeyboardInterrupt
        backends = {"fakes": driven}
        if self.beside and driven:
            backends["simulation"] = self._simulate(backend.scenario, len(driven), log)
        if len(driven) > 1 or "simulation" in backends:
            out.print()
            out.print(side_by_side(backend.scenario.vehicle_names, backends))
            out.print(f"RMSE: after {STEADY_FROM:g} s, up to the vehicle's end. SE: standard error over the seeds.")
            out.print("Hidden: frames in which a static landmark is not seen.")
        late = 1e3 * float(np.quantile(self.delays, 0.99)) if self.delays else 0.0
        out.print(
            f"{self.time:.1f} s driven, {self.missed} of {self.decisions} deadlines missed, "
            f"wake-up lateness p99 {late:.2f} ms over {len(self.delays)} ticks",
            soft_wrap=True,
        )
        out.print(
            f"The drive, bit for bit: coopenv run {quote(str(drive))} --steady-from {STEADY_FROM:g}", soft_wrap=True
        )
        if no_truth is not None:
            raise no_truth
        return backend.watchdog.trip is None

    def _drive(self, backend: Svea, driven: list[Rows], log: Console, out: Console) -> bool:
        """Drive seed after seed, and append the figures of each; the first one is reported as a run.

        Return whether true poses of all vehicles came.
        """
        run = Rollout(backend.scenario, self.seed, policy=self.policy, backend=backend, options={"arm": True})
        watched, changes = partial(links_line, backend), dict(self.overrides)
        result = execute(self.environment, run, self.out, log, changes, STEADY_FROM, "png", False, watched)
        self._count(backend, run)
        report(run, result, self.out, out)
        links_report(backend, out)
        if result.metrics["without_truth"]:
            return False
        while backend.watchdog.trip is None:
            figures = judged(run)
            driven += [figures] if len(figures) == len(run.vehicles) else []
            if self.time >= self.seconds:
                break
            run.seed += 1
            with Progress(log, f"seed {run.seed}") as progress:
                for tick in run.play():
                    progress.update(tick, f"seed {run.seed}: {watched()}")
            self._count(backend, run)
            ends = ", ".join(f"{ending.outcome} at {ending.time:.1f} s" for ending in run.endings())
            out.print(f"seed {run.seed}: {ends}", soft_wrap=True)
            if backend.watchdog.trip is not None:
                out.print(f"Stopped: {backend.watchdog.trip.reason}", soft_wrap=True)
        return True

    def _count(self, backend: Svea, run: Rollout) -> None:
        """Add the time of an episode."""
        self.time += run.ticks_recorded / run.scenario.rates.camera
        self.decisions += -(-run.ticks_recorded // run.scenario.ticks_per_decision)
        self.missed += backend.pacer.missed
        self.delays.extend(backend.pacer.lateness)

    def _simulate(self, scenario: Scenario, episodes: int, log: Console) -> list[Rows]:
        """Return the figures of the same seeds under the same policy in the simulation."""
        run, simulated = Rollout(scenario, self.seed, policy=self.policy), []
        with compile_notice(log), Progress(log, "the same seeds in the simulation", episodes) as progress:
            for run.seed in range(self.seed, self.seed + episodes):
                for _ in run.play():
                    pass
                simulated.append(judged(run))
                progress.advance()
        return simulated
