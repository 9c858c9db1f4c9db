"""An episode in a window or as a film, and driving by keys, without a display."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backend_bases import KeyEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import coopenv
from coopenv.cli import main
from coopenv.cli.options import console
from coopenv.policies import load_agent
from coopenv.policies.base import zero_policy
from coopenv.runs.live import Keyboard, Keys, drive_by_hand, watch
from coopenv.viz.topview import PictureWindow
from tests.helpers.four_way import FOUR_WAY

AT_ONCE = np.inf
SHORT = {"horizon": 3.0}


class Unseen(PictureWindow):
    """A window without a display that plays a script: what happens at each picture."""

    def __init__(self, script: Callable[[Unseen, int], None] = lambda window, number: None) -> None:
        self.pictures: list[np.ndarray] = []
        self.open, self._script = True, script
        self._canvas = FigureCanvasAgg(Figure())

    @property
    def canvas(self) -> Any:
        return self._canvas

    @property
    def is_open(self) -> bool:
        return self.open

    def show(self, picture: np.ndarray) -> None:
        self.pictures.append(picture)
        self._script(self, len(self.pictures))

    def press(self, *keys: str) -> None:
        for key in keys:
            self._canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", self._canvas, key))

    def release(self, *keys: str) -> None:
        for key in keys:
            self._canvas.callbacks.process("key_release_event", KeyEvent("key_release_event", self._canvas, key))


def test_watching_shows_the_episode_until_the_window_is_closed() -> None:
    def close(window: Unseen, number: int) -> None:
        window.open = number < 5

    scenario, window, closed = coopenv.load_scenario(FOUR_WAY, SHORT), Unseen(), Unseen(close)
    policy = load_agent("route_follower", scenario)
    stage = watch(scenario, policy, 1, console(), window, AT_ONCE)
    assert len(window.pictures) == 33  # the start is there twice, and so is the end
    assert (window.pictures[2] != window.pictures[20]).any()
    assert stage.outcomes()[0].startswith("vehicle_1: under way, position error 0.0")
    watch(scenario, policy, 1, console(), closed, AT_ONCE)
    assert len(closed.pictures) == 5


def test_keys_are_speed_and_steering() -> None:
    scenario, window = coopenv.load_scenario(FOUR_WAY), Unseen()
    driver = Keyboard(scenario, 2, zero_policy(), Keys(window.canvas))
    rows = np.zeros((4, 132), dtype=np.float32)

    def after(decisions: int) -> list[float]:
        for _ in range(decisions):
            actions = driver(rows)
        assert not actions[[0, 1, 3]].any()
        return actions[2].tolist()

    assert after(1) == [-1.0, 0.0]
    window.press("up")
    assert after(5) == pytest.approx([0.0, 0.0])
    window.press("left")
    assert after(10) == pytest.approx([1.0, 1.0])
    window.release("up", "left")
    window.press("right")
    assert after(2) == pytest.approx([1.0, 0.5])  # the speed stays, the wheel turns back
    window.release("right")
    assert after(2) == pytest.approx([1.0, 0.0])
    window.press("down")
    assert after(30) == pytest.approx([-1.0, 0.0])
    driver.reset(np.ones(4, dtype=bool))
    assert driver.keys.held == {"down"}


def test_keys_accelerate_where_the_action_is_acceleration() -> None:
    scenario, window = coopenv.load_scenario(FOUR_WAY, {"action.longitudinal": "acceleration"}), Unseen()
    driver = Keyboard(scenario, 0, zero_policy(), Keys(window.canvas))
    found = [driver(np.zeros((4, 132)))[0, 0]]
    for key in ("up", "down"):
        window.press(key)
        found.append(driver(np.zeros((4, 132)))[0, 0])
        window.release(key)
    assert found == [0.0, 1.0, -1.0]


def test_driving_by_hand_again_and_away() -> None:
    """The vehicle stands unless somebody presses a key; r begins anew, escape leaves."""

    def script(window: Unseen, number: int) -> None:
        if number == 22:
            window.release("up")
        window.press(*{3: ["up"], 18: ["r"], 22: ["escape"]}.get(number, []))

    window = Unseen(script)
    scenario = coopenv.load_scenario(FOUR_WAY, {"vehicle_defaults.motion.initial_speed": 0.0})
    stage = drive_by_hand(scenario, 0, zero_policy(), 4, console(), window, AT_ONCE)
    assert len(window.pictures) == 22
    assert stage.engine.view("seed")[0] == 5


def test_the_vehicle_goes_where_the_keys_say() -> None:
    window = Unseen(lambda window, number: window.press("up") if number == 2 else None)
    scenario = coopenv.load_scenario(FOUR_WAY, SHORT)
    stage = drive_by_hand(scenario, 1, load_agent("route_follower", scenario), 0, console(), window, AT_ONCE)
    start, now = (stage.engine.view(name)[0, 13] for name in ("start_position", "position"))
    assert now[1] - start[1] > 1.2 and abs(now[0] - start[0]) < 0.4  # northbound


def test_without_a_display_one_line_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "route_follower", "--set", "horizon=1.0"]) == 2
    error = "error: there is no display to open a window on"
    assert capsys.readouterr().err.splitlines()[-1] == f"{error}; --out DIR writes a film instead"
    assert main(["play", "urban_crossing", "--set", "horizon=1.0"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == error


def test_a_film_in_place_of_the_window(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coopenv.runs.scenes.find_spec", lambda name: None)
    out = tmp_path / "film"
    assert main(["watch", "route_follower", "--set", "horizon=2.0", "--out", str(out)]) == 0
    assert capsys.readouterr().out.count("under way, position error") == 4
    with Image.open(out / "video.gif") as film:
        assert film.n_frames > 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["play", "busy_intersection"], "all motion here is prescribed, there is nothing to drive"),
        (["play", "urban_crossing", "--vehicle", "mine"], "--vehicle mine: no such driven vehicle; known: vehicle_1, "),
        (["watch", "nobody"], "unknown agent 'nobody'"),
        (["watch", "statistics:mean"], "names no environment that it was made for; name one with --env"),
    ],
)
def test_mistakes_are_one_line(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(options) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
