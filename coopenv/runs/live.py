"""`coopenv watch | play`: an episode in a window, as it happens, or as a film."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

from coopenv.api.arguments import outcome_words
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.files import replacing_folder
from coopenv.policies import Policy, agents_for, load_policy
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.episode import play
from coopenv.runs.keyboard import AGAIN, HELP, LEAVE, Keyboard, Keys
from coopenv.runs.video import frame_stride, open_film
from coopenv.scenario import Scenario
from coopenv.viz.topview import TopView
from coopenv.viz.window import Window

FILMS = ("video.mp4", "video.gif")


class Clock:
    """Lets simulated time pass as fast as real time, or as many times as fast."""

    def __init__(self, speed: float = 1.0) -> None:
        self._speed, self._begin = speed, 0.0

    def start(self) -> None:
        """Begin at 0 s."""
        self._begin = time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Sleep until a moment of simulated time, s."""
        time.sleep(max(0.0, self._begin + moment / self._speed - time.monotonic()))


class Stage:
    """One world, drawn as it runs."""

    def __init__(self, scenario: Scenario, log: Console) -> None:
        self.scenario, self.engine = scenario, Engine(scenario)
        self.view = TopView(self.engine.backend.scenario)  # which may know of roads
        with compile_notice(log):
            self.engine.load()

    def first(self, seed: int) -> np.ndarray:
        """Return the picture of the start."""
        self.engine.reset([seed])
        return self.view.draw(self.engine)

    def run(
        self, policy: Policy, seed: int, show: Callable[[np.ndarray], None], clock: Clock, going: Callable[[], bool]
    ) -> None:
        """Play an episode, and show it while `going` says so."""
        stride = frame_stride(self.scenario)
        clock.start()
        for tick in play(self.engine, [seed], self.scenario.horizon_ticks, policy, to_the_end=False):
            if tick % stride == 0:
                show(self.view.draw(self.engine))
                if not going():
                    return
                clock.wait_until((tick + stride) / self.scenario.rates.camera)
        show(self.view.draw(self.engine))

    def outcomes(self) -> list[str]:
        """Return a line per vehicle: how it has ended so far, and how well it knows its place."""
        words, errors = outcome_words(self.scenario), self.engine.view("position_error")[0].tolist()
        ended = self.engine.view("ended")[0].tolist()
        return [
            f"{name}: {words[outcome]}, position error {error:.3f} m"
            for name, outcome, error in zip(self.scenario.vehicle_names, ended, errors, strict=True)
        ]


def opened(
    scenario: Scenario, seed: int, log: Console, window: Window | None, instead: str = ""
) -> tuple[Stage, Window]:
    """Return a world and the window that shows its start; `instead` says what can be done where there is none.

    Raises:
        CoopenvError: there is no display.
    """
    stage, window = Stage(scenario, log), window or Window(scenario.title)
    window.show(stage.first(seed))
    if not window.is_open:
        raise CoopenvError(f"there is no display to open a window on{instead}")
    return stage, window


def watch(
    scenario: Scenario,
    policy: Policy,
    seed: int,
    log: Console,
    window: Window | None = None,
    clock: Clock | None = None,
) -> Stage:
    """Show an episode in a window until it ends or the window is closed.

    Raises:
        CoopenvError: there is no display.
    """
    stage, window = opened(scenario, seed, log, window, "; --out DIR writes a film instead")
    stage.run(policy, seed, window.show, clock or Clock(), lambda: window.is_open)
    return stage


def film(scenario: Scenario, policy: Policy, seed: int, folder: Path, log: Console) -> Stage:
    """Write an episode as a film to a folder."""
    stage = Stage(scenario, log)
    with replacing_folder(folder, FILMS) as new:
        made = open_film(new, scenario.rates.camera / frame_stride(scenario))
        with made, Progress(log, f"filming {made.path.name}"):
            stage.run(policy, seed, made.add, Clock(np.inf), lambda: True)
            made.close()
    return stage


def drive_by_hand(
    scenario: Scenario,
    vehicle: int,
    others: Policy,
    seed: int,
    log: Console,
    window: Window | None = None,
    clock: Clock | None = None,
) -> Stage:
    """Let the user drive a vehicle by the arrow keys, as often as wanted.

    Raises:
        CoopenvError: there is no display.
    """
    stage, window = opened(scenario, seed, log, window)
    log.print(HELP)
    keys = Keys(window.canvas)
    policy = Keyboard(scenario, vehicle, others, keys)

    def going() -> bool:
        return window.is_open and not keys.struck & (LEAVE | AGAIN)

    while True:
        keys.struck.clear()
        stage.run(policy, seed, window.show, clock or Clock(), going)
        if not keys.struck & AGAIN:
            return stage
        seed += 1


def vehicle_index(scenario: Scenario, name: str | None) -> int:
    """Return the index of a driven vehicle by its name; of the first one without a name.

    Raises:
        CoopenvError: there is no such driven vehicle.
    """
    pairs = zip(scenario.vehicle_names, scenario.vehicles, strict=True)
    driven = [known for known, vehicle in pairs if vehicle.motion.kind == "driven"]
    if not driven:
        raise CoopenvError("all motion here is prescribed, there is nothing to drive")
    if name is not None and name not in driven:
        raise CoopenvError(f"--vehicle {name}: no such driven vehicle; known: {', '.join(driven)}")
    return scenario.vehicle_names.index(name or driven[0])


def others_of(scenario: Scenario, environment: str, name: str | None, seed: int) -> Policy:
    """Return the policy of the vehicles that nobody drives by hand: the one named, the baseline, or standing still."""
    if name is None:
        name = "route_follower" if "route_follower" in agents_for(environment) else "zero"
    return load_policy(name, scenario, seed)
