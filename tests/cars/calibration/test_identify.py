"""Identification of cars: against a model of its own here, and a bag of a fake with other settings."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv.cars.calibration.response import KINDS, Response, constants_of
from coopenv.cars.fake.settings import FakeSettings
from coopenv.cars.settings.deployment import load_deployment
from coopenv.cars.settings.profile import SVEA
from coopenv.cli.app import main
from tests.helpers import bags
from tests.helpers.commands import refused
from tests.helpers.fakes import CROSSING, Stage

GIVEN = np.array([0.05, 1.0, 1.0, 0.0, 1.0, 1.0, 2.0, 0.6, 0.52, 0.1, 0.05, 0.0, 0.0])
"""In the order of `KINDS`."""
TRUE = np.array([0.087, 1.06, 0.91, -0.022, 0.65, 0.9, 1.1, 0.52, 0.36, 0.17, 0.08, 0.012, -0.03])
DEAD, WHEELBASE = 0.06, 0.324


def commands(seconds: float, seed: int) -> np.ndarray:
    """Return rows of time, speed and steering, 20 per second: ramps to levels that last a second."""
    rng, rows, v, s = np.random.default_rng(seed), [], 0.0, 0.0
    for k in range(round(20 * seconds)):
        if k % 20 == 0:
            levels = rng.choice([0.0, rng.uniform(0.0, 0.65)], p=[0.25, 0.75]), rng.uniform(-0.5, 0.5)
        v, s = v + np.clip(levels[0] - v, -0.15, 0.15), s + np.clip(levels[1] - s, -0.2, 0.2)
        rows.append((0.05 * k, v, s))
    return np.array(rows)


@cache
def measured() -> dict[str, Any]:
    """Return what a car measures, by steps of a millisecond."""
    latency, gain, turned, offset, down, up, rate, most, sharpest, lag, slow, bias, scale = TRUE
    commanded, dt, rng = commands(50.0, 3), 0.001, np.random.default_rng(5)
    t = np.arange(0.0, 49.9, dt)
    row = np.searchsorted(commanded[:, 0], t - latency, side="right") - 1
    wanted = np.where(row < 0, 0.0, gain * commanded[np.maximum(row, 0), 1])
    wanted[np.abs(wanted) < DEAD] = 0.0
    angle = np.clip(np.where(row < 0, 0.0, turned * commanded[np.maximum(row, 0), 2]) + offset, -sharpest, sharpest)
    state, v, d = np.empty((len(t), 2)), 0.0, 0.0
    for k in range(len(t)):
        state[k] = v, d
        v += np.clip((wanted[k] - v) * dt / lag, *(np.array([-1, 1]) * dt * (down if wanted[k] < v else up)))
        v, d = min(v, most), d + np.clip((angle[k] - d) * dt / slow, -rate * dt, rate * dt)
    turn = state[:, 0] * np.tan(state[:, 1]) / WHEELBASE
    yaw = np.cumsum(turn) * dt - turn * dt
    place = np.cumsum(state[:, 0] * np.exp(1j * yaw)) * dt
    w, g, m = np.arange(3, len(t), 25), np.arange(7, len(t), 10), np.arange(0, len(t), 10)
    noise = rng.normal(size=len(m)) + 1j * rng.normal(size=len(m))
    return {
        "command_time": commanded[:, 0],
        "command_speed": commanded[:, 1],
        "command_steering": commanded[:, 2],
        "wheel_time": t[w],
        "wheel": (1.0 + scale) * state[w, 0] + 0.015 * rng.normal(size=len(w)) + 0j,
        "gyro_time": t[g],
        "gyro": turn[g] + bias + 0.015 * rng.normal(size=len(g)),
        "truth_time": t[m],
        "truth": place[m] + 0.0005 * noise,
        "truth_yaw": yaw[m],
    }


@pytest.mark.parametrize("truth", [True, False])
def test_the_constants_of_the_model_are_recovered(truth: bool) -> None:
    tracks = {name: track[: None if truth or "truth" not in name else 0] for name, track in measured().items()}
    found = constants_of(Response(tracks, WHEELBASE, 0.5, "here"), GIVEN, 0.0)
    true = TRUE.copy()
    if not truth:  # speeds are those of the wheels, and angles those that give the turn rate at them
        true[[1, 4, 5, 7]] *= 1.0 + TRUE[12]
        true[[2, 3, 6, 8]] /= 1.0 + TRUE[12]
        true[12] = 0.0
    for kind, value, error, right in zip(KINDS, found.x, found.error, true, strict=True):
        assert abs(value - right) <= 3.5 * error < 0.03, kind.name
    assert found.dead[0] <= DEAD <= found.dead[1] < DEAD + 0.03
    assert (found.error[-1] > 0.0) == truth


OVERRIDES = {
    **{"dynamics.max_speed": 0.5, "dynamics.max_acceleration": 0.9, "dynamics.speed_time_constant": 0.15},
    **{"dynamics.steering_time_constant": 0.08, "dynamics.dead_band": 0.09, "noise.velocity": 0.03},
}
SETTINGS = FakeSettings(
    latency=0.09, speed_gain=0.95, steering_offset=0.02, gyro_bias=-0.01, jitter=0.1, loss=0.04, delay_spread=0.003
)
MAP = """
environment = "svea_crossing"
markers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }
[[cars]]
name = "svea7"
[[cars]]
name = "svea3"
landmark = "ML"
marker = 3
"""


def driven(folder: Path, seconds: float) -> Path:
    """Write a bag of a fake with other settings, and its map; return the folder."""
    stage = Stage("svea_crossing", CROSSING, OVERRIDES, settings=SETTINGS)
    arrived: list[tuple[str, bytes, int]] = []
    stage.network.subscribe("**", lambda a: arrived.append((a.topic, a.payload, stage.wall + stage.now)))
    for _, speed, steering in commands(seconds, 9).tolist():
        stage.drive("svea7", speed, steering, 0.05)
    kinds = {SVEA.topic_of(car.name, role): topic.type for role, topic in SVEA.topics.items() for car in CROSSING}
    bags.write_raw(folder / "bag", arrived, kinds)
    (folder / "map.toml").write_text(MAP, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_a_fake_becomes_the_car(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = driven(tmp_path, 25.0)
    out = folder / "identified.toml"
    assert main(["identify", str(folder / "bag"), "--map", str(folder / "map.toml"), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    found = tomllib.loads(out.read_text(encoding="utf-8"))
    true = {**OVERRIDES, **{f"fake.{name}": value for name, value in SETTINGS if value is not None}}
    del true["fake.delay"], true["dynamics.max_speed"]
    for name, row in found["constants"].items():
        if name in true and not row["finding"]:
            assert abs(row["value"] - true[name]) < 4.0 * row["standard_error"] + 0.01 * abs(true[name]), name
    rows = [line.split() for line in printed.splitlines() if line.startswith(("speed ", "turn rate ", "imu, delay"))]
    assert all(float(row[-2]) < max(0.06, 0.7 * float(row[-3])) for row in rows) and len(rows) == 3
    fleet = folder / "fleet.toml"
    cars = '[[cars]]\nname = "svea7"\n[[cars]]\nname = "svea3"\nlandmark = "ML"\n'
    fleet.write_text(f'environment = "svea_crossing"\nidentified = "identified.toml"\nfakes = true\n{cars}')
    made = load_deployment(fleet)
    assert made.fake.latency == pytest.approx(0.09, abs=0.003) and "dynamics.dead_band" in made.overrides


def test_missing_topics_and_cars_are_one_line(tmp_path: Path) -> None:
    folder = driven(tmp_path, 2.0)
    (folder / "names.toml").write_text(MAP + 'topics = { manual = "/nowhere" }\n', encoding="utf-8")
    bag = str(folder / "bag")
    line = ["identify", bag, "--out", str(folder / "none.toml"), "--map"]
    assert "has no topic /nowhere" in refused(*line, str(folder / "names.toml"))
    assert "unknown car 'svea8'" in refused(*line, str(folder / "map.toml"), "--car", "svea8")
    assert not (folder / "none.toml").exists()


def test_a_bag_without_commands_is_refused() -> None:
    tracks = {**measured(), **{name: np.zeros(0) for name in ("command_time", "command_speed", "command_steering")}}
    with pytest.raises(Exception, match=r"here: 0 s with commands, speeds and turn rates; identify needs 10 s"):
        Response(tracks, WHEELBASE, 0.5, "here")
