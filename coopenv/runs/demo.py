"""`coopenv svea demo`: an experiment of the laboratory with fake cars, from the first process to the figures."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from coopenv.backends.svea.backend import Svea
from coopenv.backends.svea.opening import open_svea
from coopenv.errors import CoopenvError, listed, suggest
from coopenv.fake.fleet import fakes
from coopenv.files import replacing_file, writing
from coopenv.runs.command import execute, report
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.links import links_line, links_report
from coopenv.runs.rollouts import Rollout
from coopenv.shipped import data_directory

FLEETS = {"svea_overtaking": "overtaking.toml", "svea_crossing": "crossing.toml"}
"""Deployment files of the experiments, in `examples/fleet`."""

STEADY_FROM = 2.0
"""s: cars know their places by then."""


@dataclass(frozen=True)
class Demo:
    """What is shown."""

    environment: str
    out: Path
    policy: str = "route_follower"
    seed: int = 0
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def fleet(self) -> Path:
        """Its deployment file. Raises CoopenvError: the environment has none."""
        if self.environment not in FLEETS:
            known = f"{suggest(self.environment, FLEETS)}; known: {listed(list(FLEETS))}"
            raise CoopenvError(f"--environment {self.environment}: has no fleet of fakes{known}")
        return data_directory("examples/fleet") / FLEETS[self.environment]

    @property
    def drive(self) -> Path:
        """Where all that comes and goes is recorded."""
        return self.out.with_name(f"{self.out.name}.mcap")


@dataclass
class Punctuality:
    """How well time was kept, over all episodes."""

    time: float = 0.0  # s driven
    decisions: int = 0
    missed: int = 0
    delays: list[float] = field(default_factory=list)  # s, of each tick

    def count(self, backend: Svea, run: Rollout) -> None:
        """Add the episode that is over."""
        self.time += run.ticks_recorded / run.scenario.rates.camera
        self.decisions += -(-run.ticks_recorded // run.scenario.ticks_per_decision)
        self.missed += backend.link.missed
        self.delays.extend(backend.delays)

    def line(self) -> str:
        """Return it in words."""
        late = 1e3 * float(np.quantile(self.delays, 0.99)) if self.delays else 0.0
        return (
            f"{self.time:.1f} s driven, {self.missed} of {self.decisions} deadlines missed, "
            f"wake-up lateness p99 {late:.2f} ms over {len(self.delays)} ticks"
        )


def run_demo(demo: Demo, port: int | None, seconds: float, log: Console, out: Console) -> None:
    """Start everything, drive, report, and end everything.

    Args:
        demo: what is shown.
        port: of the router (None: a free one).
        seconds: further seeds are driven until the cars have driven so long.
        log: progress.
        out: results.

    Raises:
        CoopenvError: a process does not start, the cars cannot be armed, or results cannot be written.
    """
    fleet, kept = demo.fleet, Punctuality()
    with writing(demo.drive.parent):
        demo.drive.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        with compile_notice(log), Progress(log, "starting a router and fake cars"):
            router = stack.enter_context(fakes(fleet, port, demo.seed))
        tape = stack.enter_context(replacing_file(demo.drive))
        backend = open_svea(fleet, demo.environment, demo.overrides, record=tape, connect=router)
        stack.callback(backend.close)
        _drive(demo, backend, seconds, kept, log, out)
    out.print(kept.line(), soft_wrap=True)
    out.print(f"The drive, bit for bit: coopenv run {demo.drive} --steady-from {STEADY_FROM:g}", soft_wrap=True)


def _drive(demo: Demo, backend: Svea, seconds: float, kept: Punctuality, log: Console, out: Console) -> None:
    run = Rollout(backend.scenario, demo.seed, policy=demo.policy, backend=backend, options={"arm": True})
    watched = partial(links_line, backend)
    name, changes = demo.environment, dict(demo.overrides)
    result = execute(name, run, demo.out, log, changes, STEADY_FROM, "png", False, watched)
    kept.count(backend, run)
    report(run, result, demo.out, out)
    links_report(backend, out)
    while kept.time < seconds and backend.watchdog.trip is None:
        run.seed += 1
        with Progress(log, f"seed {run.seed}", run.ticks_planned) as progress:
            for tick in run.play():
                progress.update(tick, f"seed {run.seed}: {watched()}")
        kept.count(backend, run)
        ends = ", ".join(f"{ending.outcome} at {ending.time:.1f} s" for ending in run.endings())
        out.print(f"seed {run.seed}: {ends}", soft_wrap=True)
    if backend.watchdog.trip is not None and kept.time < seconds:
        out.print(f"Stopped: {backend.watchdog.trip.reason}", soft_wrap=True)
