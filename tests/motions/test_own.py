"""The trailer of docs/contributing/vehicle.md, a user's own drive: truth, odometry, records, pictures, errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import coopenv
from coopenv import make_vec, parallel_env
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.cli.app import main
from coopenv.observers.recording import Recording
from coopenv.scenario import Scenario, load_scenario
from coopenv.sources.sources import open_recording
from tests.helpers.builders import raw, vehicle

PAGE = Path(__file__).parents[2] / "docs/contributing/vehicle.md"
[TRAILER] = re.findall(r'```python title="mine\.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL)
WHEELBASE = 0.324


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the current one, with the page's `mine.py`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(TRAILER, encoding="utf-8")
    return tmp_path


def towing(**changes: Any) -> Scenario:
    """Return a scenario with a trailer and a car of the simulation that circle about four landmarks."""
    own = {"model": "mine.py:Trailer"}
    cars = [
        vehicle((0.0, 0.0, 0.25), 0.3, motion={"kind": "driven", "initial_speed": 0.5}, dynamics=own),
        vehicle((0.0, -4.0, 0.25), 0.3, motion={"kind": "driven"}),
    ]
    made = raw(cars, observation={"include": ["self", "odometry"]}, noise={"enabled": False}, horizon=20.0)
    return load_scenario(made, {"dynamics.max_speed": 1.5, "dynamics.max_steering": 0.6, **changes})


def test_the_class_of_the_page_has_at_most_80_lines() -> None:
    assert len(TRAILER.splitlines()) <= 80


def levels(k: int) -> np.ndarray:
    """Return the action of both vehicles at a decision."""
    return np.array([[0.2, 0.6 * np.sin(k / 6.0)]] * 2)


def test_a_trailer_drives_as_its_equations_say(folder: Path) -> None:
    """Pose and trailer against an ODE solver, to the first order of the class's steps; odometry leads along the way."""
    engine = Engine(towing(**{"rates.camera": 120.0, "rates.odometry": 240.0}), dtype="float64")
    engine.reset([0])
    y = np.array([0.0, 0.0, 0.3, 0.5, 0.0, 0.3])
    driven = engine.view("position")[0, -2:, :2].copy()
    place, R = np.array([0.0, 0.0, 0.25]), np.array(engine.view("rotation")[0, -2])
    for k in range(60):
        speed, steering = 0.6 * 1.5, levels(k)[0, 1] * 0.6

        def slope(_: float, s: np.ndarray, speed: float = speed, steering: float = steering) -> list[float]:
            fast, turn = 1e3 * (speed - s[3]), 1e3 * (steering - s[4])
            turned = s[3] * np.tan(s[4]) / WHEELBASE
            trailer = s[3] / 0.6 * np.sin(s[2] - s[5])
            way = [s[3] * np.cos(s[2]), s[3] * np.sin(s[2]), turned]
            return [*way, np.clip(fast, -2.0, 2.0), np.clip(turn, -2.0, 2.0), trailer]

        y = solve_ivp(slope, (0.0, 0.1), y, rtol=1e-8, atol=1e-8, max_step=2e-3).y[:, -1]
        for _ in range(12):
            engine.step(levels(k)[None], 1)
            place = place + R @ engine.view("increment_translation")[0, 0]
            R = R @ engine.view("increment_rotation")[0, 0]
    state = engine.world.programs[0].states[0]  # type: ignore[attr-defined]
    assert_allclose(state, y, atol=0.05)
    assert abs(state[5] - state[2]) > 0.1
    assert_allclose(engine.view("position")[0, -2], [*state[:2], 0.25], atol=1e-9)
    assert_allclose(place, engine.view("position")[0, -2], atol=0.02)  # samples between ticks hold the last twist
    assert_allclose([engine.view("speed")[0, 0], engine.view("turn")[0, 0]], state[3:5], atol=1e-9)
    axle = state[:2] - 0.6 * np.array([np.cos(state[5]), np.sin(state[5])])
    assert_allclose(engine.view("traffic_position")[0, 0, :2], axle, atol=1e-9)
    assert np.linalg.norm(engine.view("position")[0, -1, :2] - driven[1]) > 2.0, "the other car is simulated"
    engine.close()


def test_the_other_vehicle_drives_bit_for_bit_as_without_it(folder: Path) -> None:
    engines = [Engine(towing(), dtype="float64"), Engine(towing(**{"vehicles.0.dynamics": {}}), dtype="float64")]
    for engine in engines:
        engine.reset([0])
        for k in range(20):
            engine.step(levels(k)[None])
    own, simulated = (engine.view("position")[0, -1].tobytes() for engine in engines)
    assert own == simulated
    for engine in engines:
        engine.close()


def test_a_batch_and_a_restored_state_drive_as_a_single_world(folder: Path) -> None:
    """Worlds of a batch are moved one after the other."""
    single, batch = Engine(towing(), dtype="float64"), Engine(towing(), 2, dtype="float64")
    for engine in (single, batch):
        engine.reset([5, 6][: engine.world.worlds])
    for k in range(10):
        single.step(levels(k)[None])
        batch.step(np.stack([levels(k), levels(k + 7)]))
    assert batch.view("position")[0].tobytes() == single.view("position")[0].tobytes()
    assert np.linalg.norm(batch.view("position")[1, -2] - batch.view("position")[0, -2]) > 0.05
    saved = single.get_state()
    for k in range(10, 20):
        single.step(levels(k)[None])
    expected = single.view("position").copy(), single.view("traffic_rotation").copy()
    single.reset([9])
    single.set_state(saved)
    for k in range(10, 20):
        single.step(levels(k)[None])
    assert_allclose(single.view("position"), expected[0], atol=1e-12)
    assert_allclose(single.view("traffic_rotation"), expected[1], atol=1e-12)
    with pytest.raises(CoopenvError, match="state: programs"):
        single.set_state({**saved, "programs": [{"states": {7: np.zeros(6)}}]})
    for engine in (single, batch):
        engine.close()
    envs = make_vec(towing(), num_worlds=2)
    envs.reset(seed=1)
    envs.step(np.zeros((4, 2), dtype=np.float32))
    envs.close()


def test_latency_holds_the_last_command(folder: Path) -> None:
    engine = Engine(towing(**{"vehicles.0.dynamics.latency": 2 / 60}), dtype="float64")
    engine.reset([0])
    turns = []
    for _ in range(4):
        engine.step(np.array([[[0.0, 1.0]] * 2]), 1)
        turns.append(engine.view("turn")[0, 0])
    assert turns[:2] == [0.0, 0.0] and turns[2] > 0.0
    engine.close()


def test_a_trailer_is_estimated_recorded_replayed_and_drawn(folder: Path) -> None:
    """The estimate follows the truth; a log names no code and has the same way; the trailer's box is in the picture."""
    own = {"dynamics.model": "mine.py:Trailer", "horizon": 2.0}
    env = parallel_env("svea_crossing", render_mode="rgb_array", overrides=own)
    env.reset(seed=3)
    infos: Any = {}
    for _ in range(20):
        *_, infos = env.step({agent: np.array([-0.2, 0.3], dtype=np.float32) for agent in env.agents})
    assert infos["vehicle_1"]["position_error"] < 0.2
    with_box = env.render()
    env.engine.view("traffic_half")[...] = 0.0
    assert with_box is not None and (with_box != env.render()).any()
    env.close()
    words = ["record", "svea_crossing", "--set", "dynamics.model=mine.py:Trailer", "--set", "horizon=1.0"]
    assert main([*words, "--policy", "route_follower", "--out", "drive.mcap"]) == 0
    log: Recording = open_recording("drive.mcap")
    assert log.scenario is not None and log.scenario.dynamics.model == "bicycle"
    replay = parallel_env("drive.mcap")
    replay.reset(seed=0)
    for _ in range(4):
        replay.step({agent: np.zeros(2, dtype=np.float32) for agent in replay.agents})
    tick = int(replay.engine.view("tick")[0])
    assert_allclose(replay.engine.view("position")[0, -1], log.truth.position[tick, 0], atol=1e-5)
    assert np.linalg.norm(log.truth.position[-1, 0] - log.truth.position[0, 0]) > 0.1
    replay.close()


def test_a_scenario_file_names_a_class_beside_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "yard").mkdir()
    (folder / "mine.py").rename(folder / "yard/mine.py")
    text = 'title = "yard"\nhorizon = 2.0\nlandmarks = []\n[[vehicles]]\nmotion.kind = "driven"\n'
    text += 'initial_pose.position = [0, 0, 0]\ndynamics.model = "mine.py:Trailer"\n'
    (folder / "yard/yard.toml").write_text(text)
    assert load_scenario("yard/yard.toml").action_size == 2


BROKEN = {
    "columns = [": ("columns = 3 or [", "columns: expected two or three rows"),
    '"m/s", 0.0, 1.5': ('"m/s", 2.0, 1.5', "columns: expected (name, unit, low, high) with low < high, got"),
    '"rad", -0.6': ('"rad", -0.5', "columns: expected (name, unit, low, high) with low = -high, got"),
    "def step": ("def stride", "has no method step(), see docs/contributing/vehicle.md"),
    "self.wheelbase = dynamics": ("self.wheelbase = dynamic", "failed at mine.py:"),
    "[*pose, 0.0, pose[2]]": (
        "pose[:2]",
        "start: expected a state (n,) that begins with x, y, heading, speed, got (2,)",
    ),
    "return np.array([x, y, heading + turned": (
        "return np.array([x, heading + turned",
        "step: expected shape (6,), got (5,)",
    ),
    "trailer += ": ("trailer *= np.nan; trailer += ", "step: expected finite numbers, got"),
    "x, y, heading, speed, steering, trailer = state": ("1 / 0", "step failed at mine.py:"),
    "return state[4]": ("return state[4:]", "turn: expected shape (), got"),
    "[[x, y, trailer, 0.5, 0.25]]": ("[[x, y]]", "bodies: expected shape (K, 5), got (1, 2)"),
}


@pytest.mark.parametrize("place", BROKEN)
def test_a_wrong_class_is_one_line(folder: Path, place: str) -> None:
    change, line = BROKEN[place]
    assert place in TRAILER
    (folder / "mine.py").write_text(TRAILER.replace(place, change, 1), encoding="utf-8")
    with pytest.raises(CoopenvError) as caught:
        engine = Engine(towing())
        engine.reset([0])
        engine.step(np.ones((1, 2, 2)))
    text = str(caught.value)
    assert text.startswith("dynamics.model: ") and "mine.py:Trailer" in text and line in text and "\n" not in text


def test_a_run_whose_drive_fails_keeps_what_it_has(folder: Path) -> None:
    failing = TRAILER.replace("trailer += ", "assert x < 0.3, 'stuck'; trailer += ")
    (folder / "mine.py").write_text(failing, encoding="utf-8")
    with pytest.raises(
        CoopenvError, match=r"mine\.py:Trailer: step failed at .*stuck \(the .* s before it are in out\)"
    ):
        coopenv.run(towing(), policy="zero", out="out")
    with np.load(folder / "out" / "trajectory.npz") as arrays:
        assert arrays["position"][-1, 0, 0] == pytest.approx(0.3, abs=0.1)


def test_a_class_that_is_not_there_is_one_line(folder: Path) -> None:
    with pytest.raises(CoopenvError, match=r"model: .*no 'Traler' in .*did you mean 'Trailer'") as caught:
        towing(**{"vehicles.0.dynamics.model": "mine.py:Traler"})
    assert "\n" not in str(caught.value)


def test_rendered_frames_take_no_drive_of_the_users_own(folder: Path) -> None:
    rendered = Path(__file__).parents[2] / "examples/rendered_frames.toml"
    with pytest.raises(CoopenvError, match=r"dynamics\.model: .* the user's own drive needs backend = 'simulated'"):
        load_scenario(rendered, {"dynamics.model": "mine.py:Trailer"})
