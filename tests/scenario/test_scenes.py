"""Scenes that are made to measure: what their names mean, and that they are worlds in which everybody can be found."""

import math
import tomllib
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv.base import installation
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import is_scene, list_envs
from coopenv.observers.bound import ancestors, cramer_rao_ancestors
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.routes import compile_motion
from coopenv.scenario.scenes import MOST_VEHICLES, SCENES, scene_rows, scene_text
from coopenv.scenario.schema import neighbour_sets
from coopenv.training.settings import environment_file

ROADS = ("road", "crossroad")


def made(name: str, **changes: object) -> Scenario:
    """Return a scene; it must not even be doubtful, but for the length of a road."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if name.startswith(ROADS):
            warnings.filterwarnings("ignore", ".* m from the map origin")
        return load_scenario(name, {key.replace("__", "."): value for key, value in changes.items()})


SPEEDS = st.integers(10, 500).map(lambda tenths: tenths / 10)


@st.composite
def names(draw: st.DrawFn, among: Sequence[str] = tuple(SCENES)) -> str:
    """Draw the name of any scene that everybody in it can be found in."""
    kind = draw(st.sampled_from(sorted(among)))
    options = SCENES[kind].options
    given = {"vehicles": draw(st.integers(options["vehicles"].least, options["vehicles"].most))}
    given |= {"seed": draw(st.integers(0, 1000))} if "seed" in options else {}
    given |= {"speed": draw(SPEEDS)} if "speed" in options else {}
    return f"{kind}:" + ",".join(f"{key}={value}" for key, value in given.items())


@settings(max_examples=25, deadline=None)
@given(names())
def test_every_scene_is_a_world(name: str) -> None:
    scenario = made(name)
    count = len(scenario.vehicles)
    assert f"vehicles {count}" in scenario.title
    sets = neighbour_sets(scenario)
    assert all(len(targets) >= 3 for targets in sets)
    assert scenario.topology.acyclic == (not name.startswith("ring"))
    starts = [vehicle.initial_estimate for vehicle in scenario.vehicles]
    assert {(s.position_radius, s.orientation_angle) for s in starts} == {(1.0, math.radians(10.0))}


@settings(max_examples=15, deadline=None)
@given(names([kind for kind in SCENES if kind not in ROADS]))
def test_nobody_leaves_the_scene(name: str) -> None:
    """Ten minutes long nobody gets farther than 26 m, or the length of a lap, from the start."""
    scenario = made(name)
    for vehicle in scenario.vehicles:
        table = compile_motion(vehicle.motion, np.eye(3), 600.0)
        if len(table.start) > 1:
            assert table.start[-1] >= 600.0 and np.linalg.norm(table.position, axis=1).max() <= 26.0
        else:
            radius = np.linalg.norm(table.linear[0]) / np.linalg.norm(table.angular[0])
            assert 2.0 * radius <= max(26.0, 3.0 * len(scenario.vehicles) / math.pi + 1e-3)


def test_the_lane_of_eight_is_that_in_which_observers_were_found_to_fail() -> None:
    """Positions and neighbours as they were written down by those who found it."""
    scenario = made("lane:8")
    expected = [(-2.0, -10.0, 2.5)]
    expected += [(-2.0 + 0.5 * (-1) ** k, -10.0 - 3.0 * k, 2.5 + 0.3 * (k % 3)) for k in range(1, 8)]
    assert np.allclose([v.initial_pose.position for v in scenario.vehicles if v.initial_pose], expected)
    seen = [set(vehicle.neighbours or ()) for vehicle in scenario.vehicles]
    assert seen[0] == {"SL1", "SL2", "SL3"} and seen[1] == {"SL1", "SL2", "vehicle_1"}
    assert seen[2] == {"SL1", "vehicle_1", "vehicle_2"} and seen[7] == {"vehicle_5", "vehicle_6", "vehicle_7"}


def test_the_noise_is_that_of_the_tracking_environment() -> None:
    scene, known = made("random:5"), load_scenario("busy_intersection_tracking")
    for part in ("noise", "camera", "rates", "observer", "v2x"):
        assert getattr(scene, part) == getattr(known, part)
    assert scene.landmarks == known.landmarks


def test_numbers_may_be_given_by_name_or_first() -> None:
    assert made("lane:5") == made("lane:vehicles=5") == made("lane:5,seen=3")
    assert made("lane:5,seen=1").vehicles[4].neighbours == ("SL1", "SL2", "vehicle_4")
    assert made("lane:").title == made("lane:8").title
    one, two = made("random:9,seed=1"), made("random:9,seed=2")
    assert one.vehicles != two.vehicles and one == made("random:9,seed=1")


def test_a_ring_goes_round() -> None:
    recording = record(made("ring:5", horizon=0.1), 0)
    assert all(ancestors(recording, i) == (0, 1, 2, 3, 4) for i in range(5))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("lane:1", "scene lane: vehicles = '1', allowed are whole numbers 2 to 64"),
        ("lane:many", "scene lane: vehicles = 'many', allowed are whole numbers 2 to 64"),
        ("lane:8,seen=9", "scene lane: seen = '9', allowed are whole numbers 1 to 8"),
        ("roots:8,seed=1", "scene roots: unknown option 'seed'; allowed: vehicles (3..64)"),
        ("tree:8,9", "scene tree: unknown option '9'"),
        ("ring:8,seen=1,seen=2", "scene ring: seen is given twice"),
        ("lanes:8", "unknown environment 'lanes:8'"),
        ("road:0", "scene road: vehicles = '0', allowed are whole numbers 2 to 64"),
        ("road:3,speed=-1", "scene road: speed = '-1', allowed are numbers 1 to 50"),
        ("road:3,speed=nan", "scene road: speed = 'nan', allowed are numbers 1 to 50"),
        ("road:3,speed=1e1", "scene road: speed = '1e1', allowed are numbers 1 to 50"),
        ("road:3,foo=1", "unknown option 'foo'; allowed: vehicles (2..64), speed (1..50), lanes (1..2)"),
        ("road:3,lanes=1.5", "scene road: lanes = '1.5', allowed are whole numbers 1 to 2"),
        ("crossroad:9,lanes=1", "unknown option 'lanes'; allowed: vehicles (2..64), speed (1..50)"),
    ],
)
def test_a_wrong_name_is_told_in_one_line(name: str, told: str) -> None:
    with pytest.raises(CoopenvError) as caught:
        load_scenario(name)
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_paths_are_no_scenes() -> None:
    assert is_scene("lane:8") and not is_scene("lane:8.toml") and not is_scene("lane:a/b") and not is_scene("lane")


def test_what_is_known_without_the_simulation_is_all_there_is() -> None:
    assert tuple(SCENES) == installation.SCENES and [row["name"] for row in scene_rows()] == [
        f"{kind}:N" for kind in SCENES
    ]
    assert not set(SCENES) & set(list_envs())


def test_the_text_is_a_file_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(scene_text("tree:9"), encoding="utf-8")
    assert load_scenario(file) == made("tree:9")
    told = environment_file("tree:9")
    assert told.name == "tree_9.toml" and tomllib.loads(told.text or "") == tomllib.loads(scene_text("tree:9"))


def test_as_many_vehicles_as_allowed_run() -> None:
    """All of them are recorded, and the last of a lane is known to a few centimetres more than the one before."""
    recording = record(made(f"ring:{MOST_VEHICLES}", horizon=0.2), 0)
    assert recording.bearings.shape[1:3] == (MOST_VEHICLES, MOST_VEHICLES + 3)
    assert recording.visible[1:].sum(axis=2).min() == 3


@pytest.mark.parametrize("name", ["lane:6", "roots:6", "tree:7", "random:6,seed=4", "ring:4", "road:5", "crossroad:5"])
def test_everybody_can_be_found(name: str) -> None:
    """The bound falls below a quarter of a metre within seconds: the bearings of every vehicle suffice."""
    bound = cramer_rao_ancestors(record(made(name, horizon=8.0, rates__camera=20.0, rates__odometry=20.0), 0))
    assert bound.position[0].min() > 0.7 and bound.position[-1].max() < 0.3
