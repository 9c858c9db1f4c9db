"""Episodes in a window, driven by an agent or from the keyboard, and films."""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console

from coopenv.api.arguments import outcome_words
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import action_fields
from coopenv.base.errors import CoopenvError
from coopenv.base.files import replacing_file, replacing_folder
from coopenv.policies import Policy, agents_for, load_policy, restart
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.rollouts import play
from coopenv.runs.video import film_at, frame_stride, open_film
from coopenv.scenario import Scenario
from coopenv.viz.scene import SceneRecord
from coopenv.viz.topview import TopView, Window

LEAVE, AGAIN = {"escape", "q"}, {"r"}
HELP = "Arrow keys: faster, slower, left, right. r: again. Escape: leave."
FULL_SPEED, FULL_STEERING = 1.0, 0.4
"""s that a key is held for the whole range: from standstill to top speed, from straight ahead to full steering."""


class Keys:
    """Which keys are held down, as the canvas of a window tells."""

    def __init__(self, canvas: Any) -> None:
        """Listen to a canvas of matplotlib."""
        self.held: set[str] = set()
        self.struck: set[str] = set()
        """Keys pressed since the set was cleared."""
        canvas.mpl_connect("key_press_event", self._press)
        canvas.mpl_connect("key_release_event", self._release)

    def _press(self, event: Any) -> None:
        if event.key is not None:
            self.held.add(event.key)
            self.struck.add(event.key)

    def _release(self, event: Any) -> None:
        self.held.discard(event.key)

    def direction(self, plus: str, minus: str) -> float:
        """Return 1, -1 or 0 by which of two keys is held."""
        return float(plus in self.held) - float(minus in self.held)


class Keyboard:
    """A policy of one world that drives a vehicle by keys and leaves the others to another policy."""

    def __init__(self, scenario: Scenario, vehicle: int, others: Policy, keys: Keys) -> None:
        """Choose the driver of each vehicle; `vehicle` is an index."""
        self.keys, self._vehicle, self._others = keys, vehicle, others
        self._longitudinal = action_fields(scenario, scenario.limits[vehicle])[0]
        self._period = 1.0 / scenario.rates.decision
        self.reset(np.ones(len(scenario.vehicles), dtype=bool))

    def reset(self, mask: np.ndarray) -> None:
        """Begin anew, standing, with straight wheels."""
        low, high = self._longitudinal.low, self._longitudinal.high
        self._level = -(high + low) / (high - low)  # of nothing: no speed, no acceleration
        self._still, self._steering = self._level, 0.0
        restart(self._others, mask)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions, (vehicles, A)."""
        actions = np.array(self._others(observations), dtype=float)
        pedal, wheel = self.keys.direction("up", "down"), self.keys.direction("left", "right")
        if self._longitudinal.name == "speed":
            self._level = float(
                np.clip(self._level + pedal * (1.0 - self._still) * self._period / FULL_SPEED, -1.0, 1.0)
            )
            if pedal < 0.0 and self._longitudinal.low == 0.0:
                self._level = max(self._level, self._still)
        else:
            self._level = pedal
        step = self._period / FULL_STEERING
        self._steering = float(np.clip(wheel, self._steering - step, self._steering + step))
        actions[self._vehicle] = 0.0
        actions[self._vehicle, :2] = self._level, self._steering
        return actions


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
        """Play an episode, and show it while `going` returns True."""
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
    """Return the policy of the vehicles without a human driver: the named one, the baseline, or standing still."""
    if name is None:
        name = "route_follower" if "route_follower" in agents_for(environment) else "zero"
    return load_policy(name, scenario, seed)


def write_film(
    record: SceneRecord,
    path: Path,
    fps: float,
    speed: float = 1.0,
    width: int = 896,
    panel: bool = True,
    on_progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write a film of a scene; return how many pictures it has.

    Args:
        record: the scene.
        path: of the film, which is replaced as a whole; its suffix is the format.
        fps: pictures a second; frames of the scene are repeated where it has fewer.
        speed: times real time.
        width: of the pictures, pixels, at most.
        panel: table and legend beside the map.
        on_progress: called with the share of the pictures that are drawn; the file is written after the last.

    Raises:
        CoopenvError: unknown format, or it needs an extra.
        OutputError: the file cannot be written.
    """
    film_at(path, fps)  # before anything is drawn
    chosen = frames_at(record.time, fps, speed)
    with (
        replacing_file(path) as new,
        closing(TopView(record.scenario, panel=panel)) as view,
        film_at(new, fps) as film,
    ):
        for done, k in enumerate(chosen, start=1):
            film.add(_within(view.paint(record.frame(int(k))), width))
            on_progress(done / len(chosen))
        film.close()
    return len(chosen)


def frames_at(time: np.ndarray, fps: float, speed: float) -> np.ndarray:
    """Return which frames, of times (K,) s, a film shows: the last one that is there at each of its pictures."""
    count = int(np.floor((time[-1] - time[0]) / speed * fps + 1e-6)) + 1
    moments = time[0] + np.arange(count) * speed / fps
    return np.asarray(np.searchsorted(time, moments + 1e-6, side="right") - 1)


def _within(picture: np.ndarray, width: int) -> np.ndarray:
    """Return a picture that is no wider than that."""
    if picture.shape[1] <= width:
        return picture
    size = width, round(picture.shape[0] * width / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))
