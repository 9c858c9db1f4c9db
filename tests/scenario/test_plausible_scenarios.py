"""Units of the keys of scenarios: mistakes are named, and no shipped scenario is implausible."""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

import coopenv
from coopenv.base.errors import CoopenvError, ScenarioWarning
from coopenv.base.units import units_of
from coopenv.scenario.files import load_scenario
from coopenv.scenario.scenes import SCENES
from coopenv.scenario.schema import Scenario
from coopenv.scenario.sites import Streets
from coopenv.scenario.task import RewardWeights

ROOT = Path(__file__).parents[2]
LARGE = ["road:2,speed=50", "road:60,speed=50,lanes=1", "crossroad:40,speed=50", "lane:60"]
MARKS = [
    {"name": "a", "position": [6, 3, 1]},
    {"name": "b", "position": [5, -4, 2]},
    {"name": "c", "position": [-4, 6, 3]},
]
CAR = {"motion": {"kind": "driven"}, "goal": {"position": [8, 0, 0]}, "initial_pose": {"position": [-5, 0, 0]}}
ROUTE = {"name": "way", "waypoints": [[0, 0], [50, 0]]}


def doubts(source: Any, overrides: dict[str, Any] | None = None) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scenario(source, overrides)
    lines = [str(line.message) for line in caught if issubclass(line.category, ScenarioWarning)]
    return [line for line in lines if "implausible" in line]


def yard() -> dict[str, Any]:
    return {"title": "t", "horizon": 5.0, "landmarks": MARKS, "vehicles": [CAR], "routes": [ROUTE]}


MISTAKES: dict[str, tuple[Any, str]] = {
    "vehicles.0.initial_pose.yaw": (90, "degrees"),
    "vehicles.0.initial_pose.yaw_spread": (5, "degrees"),
    "vehicles.0.initial_estimate.orientation_angle": (20, "degrees"),
    "vehicles.0.initial_estimate.position_radius": (500, "millimetres"),
    "vehicles.0.initial_pose.position": ([-5000, 0, 0], "millimetres"),
    "vehicles.0.goal.radius": (300, "millimetres"),
    "vehicles.0.initial_pose.position_spread": ([100, 0, 0], "centimetres"),
    "vehicles.0.body": ({"size": [4500, 1800, 1500]}, "millimetres"),
    "noise.bearing.scale": (3.0, "degrees"),
    "noise.angular_velocity": (0.57, "degrees|deg/s"),
    "noise.gyro_bias": ([0, 0, 1.0], "deg/s"),
    "noise.velocity": (100, "mm/s"),
    "noise.odometry_scale": (2.0, "per cent"),
    "landmarks.*.position": ([6000, 3000, 1000], "millimetres"),
    "landmarks.1.position_spread": ([1000, 0, 0], "millimetres"),
    "dynamics.max_speed": (50, "km/h"),
    "dynamics.wheelbase": (324, "millimetres"),
    "dynamics.steering_time_constant": (50, "milliseconds"),
    "dynamics.max_steering_rate": (60, "deg/s"),
    "camera.focal_length": ([0.004, 0.004], "metres"),
    "camera.extrinsics_error": (1.0, "degrees"),
    "camera.position": ([100, 0, 250], "millimetres"),
    "camera.range": (5000, "millimetres"),
    "v2x.range": (150_000, "millimetres"),
    "images.side": (160, "millimetres"),
    "rates.decision": (0.1, "period"),
    "horizon": (50_000, "milliseconds"),
    "faults.lie.start": (3000, "milliseconds"),
    "routes.0.waypoints": ([[0, 0], [50_000, 0]], "millimetres"),
    "noise.slip.size": (30, "per cent"),
}


@pytest.mark.parametrize("key", MISTAKES)
def test_a_mistake_of_units_is_named_in_one_line(key: str) -> None:
    value, mistake = MISTAKES[key]
    [line] = doubts(yard(), {key: value})
    place = re.escape(key).replace(r"\*", "0")
    assert re.match(place + r"[.\w]*: [-\d.e+]+ [\w/^ ]+ is implausible \(expected magnitude [-\w.+ ]+\): ", line)
    assert re.search(mistake, line)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("action.pan", {"limit": 90, "rate": 1.0}, r"pan\.limit: .*, got 90: degrees in place of radians\?"),
        ("dynamics.max_steering", 40, r"max_steering: .*, got 40: degrees in place of radians\?"),
        ("faults.lie", {"kind": "replay", "age": 500}, r"lie\.age: .*, got 500: milliseconds in place of seconds\?"),
        ("v2x.loss", 10, r"v2x\.loss: .*, got 10: per cent in place of a share\?"),
        ("landmarks.0.presence", 90, r"presence: .*, got 90: per cent in place of a share\?"),
        ("camera.range", -20, r"camera\.range: Input should be greater than 0, got -20$"),
    ],
)
def test_an_error_of_a_bound_names_the_likely_unit(key: str, value: Any, words: str) -> None:
    with pytest.raises(CoopenvError, match=words):
        load_scenario(yard(), {key: value})


def test_texts_with_units_are_accepted_in_files_dicts_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "yard.toml"
    path.write_text(
        'title = "t"\nhorizon = "1 min"\nnoise.bearing.scale = "3 deg"\n[vehicle_defaults]\n'
        'initial_pose.yaw = "90 deg"\n[[vehicles]]\nmotion.kind = "driven"\n'
        'initial_pose.position = ["-500 cm", 0, "20 mm"]\n[[landmarks]]\nname = "a"\nposition = ["1 km", 2, 3]\n'
        '[[landmark_groups]]\nname = "g"\ncount = 2\nheight = ["2 m", 3]\n'
        'boxes = [{center = [0, "5 m"], half = ["100 cm", 1]}]\n'
    )
    made = load_scenario(path, {"camera.range": "2000 cm", "rates.camera": "0.06 kHz"})
    assert (made.horizon, made.camera.range, made.rates.camera) == (60.0, 20.0, 60.0)
    assert load_scenario(yard(), {"v2x.loss": "10 %"}).v2x.loss == pytest.approx(0.1)
    assert made.noise.bearing.scale == pytest.approx(0.0523598776)
    assert made.vehicles[0].initial_pose is not None
    assert made.vehicles[0].initial_pose.position == pytest.approx((-5.0, 0.0, 0.02))
    assert made.landmarks[0].position == (1000.0, 2.0, 3.0)
    assert (made | {"dynamics.max_speed": "3.6 km/h"}).dynamics.max_speed == pytest.approx(1.0)


def test_coordinates_far_from_the_file_s_origin_are_plausible_about_the_map_s() -> None:
    east, north = 674_000.0, 6_580_000.0
    marks = [{**mark, "position": [mark["position"][0] + east, mark["position"][1] + north, 1.0]} for mark in MARKS]
    car = {"motion": {"kind": "driven"}, "initial_pose": {"position": [east, north, 0.0]}}
    world = {"title": "t", "horizon": 5400.0, "map": {"origin": [east, north, 0.0]}, "landmarks": marks}
    assert doubts({**world, "vehicles": [car]}) == []


SOURCES = [
    *coopenv.list_envs(),
    *(f"{kind}:{scene.options['vehicles'].default:g}" for kind, scene in SCENES.items()),
    *LARGE,
    *(str(path.relative_to(ROOT)) for path in (ROOT / "examples").rglob("*.toml") if "\nhorizon" in path.read_text()),
]


@pytest.mark.parametrize("source", SOURCES)
def test_no_shipped_scenario_is_implausible(source: str) -> None:
    assert doubts(str(ROOT / source) if source.endswith(".toml") else source) == []


def test_streets_are_named_by_their_own_key() -> None:
    world = {"title": "t", "horizon": 5.0, "landmarks": MARKS, "streets": {"blocks": [1, 1], "height": 12_000.0}}
    assert doubts({**world, "vehicles": [{"motion": {"kind": "driven"}}]})[0].startswith("streets.height: 12000 m is")


def sections(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for info in model.model_fields.values():
        kinds = [info.annotation]
        while kinds:
            kind = kinds.pop()
            kinds += get_args(kind)
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from sections(kind)


def test_every_number_with_a_unit_in_its_description_has_that_unit() -> None:
    unit = re.compile(r"(?:^|, )(m|s|rad|Hz|m/s|rad/s|pixels)(?=[.;,: (]|$)")
    without = {
        f"{model.__name__}.{name}"
        for model in {*sections(Scenario), *sections(Streets)}
        for name, text in model.meanings().items()
        if unit.search(text) and units_of(model).get(name) is None and model is not RewardWeights
    }
    assert without == {"Images.blur", "Camera.image_size", "Lie.std"}
