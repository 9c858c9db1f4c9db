"""Calibration on drives that are computed here, and the command on logs and on bad input."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import DataError
from coopenv.cars.calibration.calibrate import Calibrated, calibrate, toml_text
from coopenv.cars.calibration.drives import CalibrationDrive, CarDrive
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.sensors import Correction
from coopenv.cli.app import main
from coopenv.scenario import load_scenario
from tests.helpers.commands import refused
from tests.helpers.env_suite import rest_slow

LENS = Calibration((316, 208), (213.161906, 213.521038), (154.841998, 114.98398), (-0.352043, 0.137879, 0.0, 0.0, 0.0))
MOUNTING = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MARKERS = np.array(
    [[0.1, 2.5, 0.4], [-1.4, 2.0, 0.08], [1.6, 1.4, 0.25], [2.3, -0.4, 0.08], [0.9, -2.2, 0.4], [-1.2, -1.9, 0.1]]
)
LEVER = np.array([0.3218, 0.0, 0.2233])
SCALE, BIAS = 0.02, 0.006


def imaged(ray: np.ndarray, lens: Calibration) -> np.ndarray:
    k1, k2, k3, k4, *more = lens.distortion
    x, y = ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2
    if len(more) == 4:
        radial /= 1.0 + more[1] * r2 + more[2] * r2**2
    elif not more:
        a = np.arctan(np.sqrt(r2))
        radial = a * (1.0 + k1 * a**2 + k2 * a**4 + k3 * a**6 + k4 * a**8) / np.sqrt(r2)
    return np.stack([x * radial, y * radial], axis=-1) * lens.focal_length + np.array(lens.principal_point)


@cache
def measured(lens: Calibration = LENS) -> dict[str, Any]:
    """Return what a car measures that drives figures of eight, by formulas of its own."""
    rng, dt = np.random.default_rng(3), 0.001
    t = np.arange(0.0, 20.0, dt)
    speed = 0.6 + 0.2 * np.sin(1.4 * t)
    rate = 0.9 * np.sin(2.0 * np.pi * t / 15.0) + 0.7
    yaw = 1.2 + np.cumsum(rate) * dt
    place = np.cumsum(speed * np.exp(1j * yaw)) * dt - 0.3 - 0.4j
    found, frames = [], np.arange(500, len(t) - 500, 33)
    for k in frames:
        flat = np.exp(-1j * yaw[k]) * (MARKERS[:, 0] + 1j * MARKERS[:, 1] - place[k])
        ray = (np.stack([flat.real, flat.imag, MARKERS[:, 2]], axis=-1) - LEVER) @ MOUNTING
        ahead = np.flatnonzero((ray[:, 2] > 0.2) & (np.abs(ray[:, 0]) < 0.75 * ray[:, 2]))
        pixel = np.rint(imaged(ray[ahead], lens) + 0.6 * rng.normal(size=(len(ahead), 2)))
        found += [
            (t[k], i, *p) for i, p in zip(ahead, pixel.tolist(), strict=True) if 2 < p[0] < 313 and 2 < p[1] < 205
        ]
    w, g, m = (np.arange(0, len(t), step) for step in (20, 10, 20))
    noise = 0.0007 * (rng.normal(size=len(m)) + 1j * rng.normal(size=len(m)))
    return {
        "seen": np.array(found),
        "wheel_time": t[w],
        "wheel": (1.0 + SCALE) * speed[w] + 0.014 * rng.normal(size=len(w)) + 0j,
        "gyro_time": t[g],
        "gyro": rate[g] + BIAS + 0.02 * rng.normal(size=len(g)),
        "truth_time": t[m],
        "truth": place[m] + noise,
        "truth_yaw": yaw[m] + 0.001 * rng.normal(size=len(m)),
    }


def drive(
    lever: np.ndarray = LEVER,
    turned: float = 0.0,
    lens: Calibration | None = LENS,
    markers: np.ndarray = MARKERS,
    late: float = 0.0,
    truth_late: float = 0.0,
    seen_by: Calibration = LENS,
) -> CalibrationDrive:
    """Return the drive as it looks to a calibration that is given these constants."""
    tracks = dict(measured(seen_by))
    seen = tracks.pop("seen")
    c, s = np.cos(turned), np.sin(turned)
    ray, there = rays(seen[:, 2:], lens or seen_by)
    seen, ray = seen[there], ray[there]
    car = CarDrive(
        name="car",
        vehicle=0,
        mounting=np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ MOUNTING,
        lever=lever,
        lens=lens,
        time=seen[:, 0] + late,
        target=seen[:, 1].astype(int),
        ray=ray,
        pixel=seen[:, 2:],
        height=0.0,
        **{**tracks, "truth_time": tracks["truth_time"] + truth_late},
    )
    names = tuple(f"M{i}" for i in range(len(markers)))
    return CalibrationDrive((car,), names, markers, load_scenario("svea_crossing"))


def off(result: Calibrated, name: str, true: float) -> float:
    """Return by how many standard errors a constant is off."""
    row = next(row for row in result.rows if row.name == name)
    return abs(row.value - true) / row.error


MOVED = MARKERS + np.array([[0, 0, 0]] * 2 + [[0.04, 0, 0]] + [[0, 0, 0]] * 3)
NO_DISTORTION = Calibration(LENS.image_size, LENS.focal_length, LENS.principal_point, (0.0,) * 5)
OTHER_FOCUS = Calibration(LENS.image_size, (220.0, 220.4), LENS.principal_point, LENS.distortion)
FOCUS: Any = ({"lens": OTHER_FOCUS}, {"car: focal length"}, {"car.camera.fx": 213.161906, "car.camera.fy": 213.521038})
RIGHT: Any = ({}, set(), {"car.wheel.scale": SCALE, "car.gyro.bias": BIAS})
HEIGHT: Any = ({"lever": LEVER - [0, 0, 0.02]}, {"car: camera position"}, {"car.camera.z": 0.2233})
LATE: Any = ({"truth_late": 0.15}, {"car: stamps"}, {"car.truth.offset": -0.15})
ROWS = [
    *((*row, False) for row in (RIGHT, FOCUS, HEIGHT)),
    *((*row, True) for row in (RIGHT, FOCUS, LATE)),
    (
        {"turned": np.radians(-1.5), "lever": LEVER + np.array([0.06, 0, 0]), "late": 0.06},
        {"car: camera orientation", "car: camera position", "car: stamps"},
        {"car.camera.yaw": 1.5, "car.camera.x": 0.3218, "car.camera.offset": -0.06},
        False,
    ),
    (
        {"lens": NO_DISTORTION, "markers": MOVED},
        {"car: lens distortion", "marker M2: position"},
        {"car.camera.k1": -0.352043, "car.camera.k2": 0.137879, "marker.M2.x": 1.6},
        False,
    ),
    (
        {"markers": MOVED[[1, 0, 2, 3, 4, 5]], "late": -0.08, "truth_late": 0.1},
        {"markers M0 and M1 are exchanged", "marker M2: position", "car: stamps"},
        {"marker.M2.x": 1.6, "marker.M0.y": 2.5, "car.camera.offset": 0.08, "car.truth.offset": -0.1},
        True,
    ),
]
"""Constants, what is named, what is found, and whether there is motion capture."""


@pytest.mark.parametrize(("given", "named", "true", "truth"), rest_slow(ROWS, 2, 7, 8))
def test_wrong_constants_are_named_and_recovered(
    given: dict[str, Any], named: set[str], true: dict[str, float], truth: bool
) -> None:
    result = calibrate(drive(**given), truth)
    assert sorted(line.split(" is wrong")[0] for line in result.findings) == sorted(named)
    for name, value in true.items():
        assert off(result, name, value) < 3.0, name


def test_stamps_that_import_has_moved_are_no_finding() -> None:
    given = drive()
    moved = replace(given.cars[0], topics=(("/camera", -0.12), ("/wheels", 0.0), ("/truth", 0.0)))
    result = calibrate(replace(given, cars=(moved,)))
    assert not result.findings and result.notes == ("car: import has moved the stamps of /camera by -0.120 s",)


def test_bearings_alone_give_the_mounting_and_no_intrinsics() -> None:
    given = drive(lever=LEVER - [0, 0, 0.02])
    car = given.cars[0]
    blind = replace(car, lens=None, pixel=np.full_like(car.pixel, np.nan))
    result = calibrate(replace(given, cars=(blind,)))
    assert off(result, "car.camera.z", 0.2233) < 3.0 and len(result.findings) == 1
    assert not any(row.name.endswith((".fx", ".k1")) for row in result.rows)


MODELS = [(-0.2, 0.03, 0.0, 0.0, 0.0, 0.15, 0.02, 0.0), (-0.03, 0.01, -0.004, 0.001)]
"""Coefficients of a rational model and of a fisheye."""


@pytest.mark.parametrize("bent", rest_slow([(bent,) for bent in MODELS], 1))
def test_other_models_of_a_lens_are_calibrated(bent: tuple[float, ...]) -> None:
    lens = replace(LENS, distortion=bent)
    given = drive(lens=replace(lens, focal_length=(220.0, 220.4)), seen_by=lens)
    result = calibrate(replace(given, cars=(replace(given.cars[0], topics=TOPICS),)))
    assert [line.split(" is wrong")[0] for line in result.findings] == ["car: focal length"]
    assert off(result, "car.camera.fx", 213.161906) < 3.0 and off(result, "car.camera.fy", 213.521038) < 3.0
    assert sum(row.name.startswith("car.camera.k") for row in result.rows) == (6 if len(bent) == 8 else 4)
    written = tomllib.loads(toml_text(result))
    found = Correction(**written["corrections"]["car"]).lens(given.cars[0].lens or LENS)
    assert abs(found.focal_length[0] - 213.161906) < 1.0 and len(found.distortion) == len(bent)
    assert not any("distortion" in key for key in written["overrides"]), "the environment has another model"


TOPICS = (("/camera", -0.12), ("/wheels", -0.12), ("/truth", 0.3))


def test_the_file_has_constants_that_hold_for_other_drives() -> None:
    """Delays of topics against the turn rates of their car, and errors of odometry; no offset of a clock."""
    given = drive()
    car = replace(given.cars[0], topics=TOPICS, gyro_added=-0.06)
    result = calibrate(replace(given, cars=(car,)))
    finding = {row.name: row.finding for row in result.rows}
    assert finding["car.wheel.scale"] == "within the environment's noise" and finding["car.camera.fx"] == ""
    written = tomllib.loads(toml_text(result))
    assert written["clocks"] == {"leads": {"/camera": -0.06, "/wheels": -0.06}}
    assert written["corrections"]["car"]["wheel_scale"] == pytest.approx(SCALE, abs=0.01)
    assert written["corrections"]["car"]["gyro_bias"] == pytest.approx(BIAS, abs=0.003)
    removed = {"wheel": car.wheel / (1.0 + SCALE), "gyro": car.gyro - BIAS, "corrected": (SCALE, BIAS)}
    again = calibrate(replace(given, cars=(replace(car, **removed),)))
    assert off(again, "car.wheel.scale", SCALE) < 3.0 and off(again, "car.gyro.bias", BIAS) < 3.0


def test_turn_rates_in_degrees_are_left_to_the_doctor_and_give_no_overrides() -> None:
    given = drive()
    car = replace(given.cars[0], gyro=np.degrees(given.cars[0].gyro), topics=TOPICS)
    result = calibrate(replace(given, cars=(car,)))
    assert not result.explained and "units" in result.findings[0] and "coopenv doctor" in result.findings[0]
    written = tomllib.loads(toml_text(result))
    assert written["overrides"] == {} == written["clocks"]["leads"] and "corrections" not in written


def test_the_file_sets_wrong_constants() -> None:
    written = tomllib.loads(toml_text(calibrate(drive(lever=LEVER - [0, 0, 0.02]))))
    scenario = load_scenario("svea_crossing", {k: v for k, v in written["overrides"].items() if "landmarks" not in k})
    assert abs(scenario.cameras[0].position[2] - 0.2233) < 1e-3
    np.testing.assert_allclose(scenario.cameras[0].to_body(), MOUNTING, atol=1e-6)
    assert written["constants"]["car.camera.z"]["finding"] == "wrong"
    assert abs(written["overrides"]["noise.velocity"] - 0.014 * np.sqrt(2)) < 0.002


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive, as a log."""
    path = tmp_path_factory.mktemp("calibration") / "drive.mcap"
    line = ["record", "svea_crossing", "--policy", "route_follower", "--set", "horizon=12", "--no-scene", "--no-replay"]
    assert main([*line, "--out", str(path)]) == 0
    return path


def test_the_command_reads_a_log(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(log), "--out", str(log.parent)]) == 0
    printed = capsys.readouterr().out
    assert "No constant is wrong." in printed and "vehicle_1.wheel.scale" in printed
    assert (log.parent / "residuals_vehicle_1.png").stat().st_size > 10_000
    assert "clocks" in tomllib.loads((log.parent / "calibration.toml").read_text(encoding="utf-8"))


MAP = (
    'environment = "crossing_path"\n'
    'names = "authors"\nmarkers = {{ SL1 = 1 }}\n{}\n[[cars]]\nname = "svea3"\nagent = 8\n'
)
BAD: list[tuple[list[str], str]] = [
    (["nowhere.mcap"], "nowhere.mcap"),
    (["nowhere.bag"], "no such bag: nowhere.bag"),
    (["svea_crossing"], "no such bag: svea_crossing"),
    (["empty.bag"], "empty.bag: needs the map of its topics, --map topics.toml"),
    (["LOG", "LOG"], "needs the map of its topics"),
    (["LOG", "--set", "camera.position=[0,0,0]"], "--override: needs the map"),
    (["empty.bag", "--map", "nowhere.toml"], "nowhere.toml: cannot be read"),
    (["nowhere.bag", "--map", "good.toml"], "no such bag: nowhere.bag"),
    (["empty.bag", "--map", "calibrated.toml"], "nowhere.toml"),
    (["empty.bag", "--map", "number.toml"], "calibration"),
    (["short.mcap"], "short.mcap: vehicle_1 has"),
    (["empty.bag", "--map", "good.toml", "--set", "camera"], "--set or --override camera: expected KEY=VALUE"),
]


@pytest.mark.parametrize(("arguments", "line"), BAD)
def test_bad_input_is_one_line(arguments: list[str], line: str, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(log.parent)
    for name, more in {"good": "", "calibrated": 'calibration = "nowhere.toml"', "number": "calibration = 3"}.items():
        Path(f"{name}.toml").write_text(MAP.format(more), encoding="utf-8")
    Path("empty.bag").touch()
    if arguments == ["short.mcap"]:
        short = ["record", "svea_crossing", "--set", "horizon=3", "--no-scene", "--no-replay", "--out", "short.mcap"]
        assert main(short) == 0
    assert line in refused("calibrate", *[str(log) if a == "LOG" else a for a in arguments], "--out", "results")
    assert not Path("results").exists()


def test_residuals_that_nothing_explains_are_no_calibration() -> None:
    given = drive()
    rows = {name: getattr(given.cars[0], name)[::6] for name in ("time", "target", "ray", "pixel")}
    rows["pixel"] = np.random.default_rng(0).uniform(5.0, 200.0, rows["pixel"].shape)
    result = calibrate(replace(given, cars=(replace(given.cars[0], **rows),)), truth=False)
    assert [line[:40] for line in result.findings] == ["car: no constant explains the residuals "]
    assert not any(row.finding == "wrong" for row in result.rows)


def test_one_landmark_is_too_few_without_motion_capture() -> None:
    given = drive()
    one = given.cars[0].target == 0
    rows = {name: getattr(given.cars[0], name)[one] for name in ("time", "target", "ray", "pixel")}
    alone = replace(given, cars=(replace(given.cars[0], **rows),))
    with pytest.raises(DataError, match="two static landmarks are never seen within 6 s"):
        calibrate(alone, truth=False)
    assert not calibrate(alone).findings
