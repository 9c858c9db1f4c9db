"""Parametric scenes: what their names mean, that every vehicle can be found, and roads against plain geometry."""

from __future__ import annotations

import math
import tomllib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coopenv.base import installation
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import is_scene, list_envs
from coopenv.estimation.poses import Array
from coopenv.observers import run
from coopenv.observers.bound import ancestors, cramer_rao_ancestors
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.routes import compile_motion
from coopenv.scenario.scenes import MOST_VEHICLES, SCENES, scene_rows, scene_text
from coopenv.scenario.schema import neighbour_sets
from coopenv.scenario.sites import crossroad, road
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
    """Draw the name of any scene that everybody in it can be found in; thousands of vehicles take seconds to load."""
    kind = draw(st.sampled_from(sorted(among)))
    options = SCENES[kind].options
    given = {"vehicles": draw(st.integers(options["vehicles"].least, min(options["vehicles"].most, 120)))}
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
def test_vehicles_stay_in_the_scene(name: str) -> None:
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
    ("name", "message"),
    [
        ("lane:1", "scene lane: vehicles = '1', allowed are whole numbers 2 to 4096"),
        ("lane:8,seen=9", "scene lane: seen = '9', allowed are whole numbers 1 to 8"),
        ("roots:8,seed=1", "scene roots: unknown option 'seed'; allowed: vehicles (3..4096)"),
        ("ring:8,seen=1,seen=2", "scene ring: seen is given twice"),
        ("lanes:8", "unknown environment 'lanes:8'"),
        ("road:3,speed=-1", "scene road: speed = '-1', allowed are numbers 1 to 50"),
        ("road:3,speed=1e1", "scene road: speed = '1e1', allowed are numbers 1 to 50"),
        ("road:3,foo=1", "unknown option 'foo'; allowed: vehicles (2..64), speed (1..50), lanes (1..2)"),
    ],
)
def test_a_wrong_name_is_one_error_line(name: str, message: str) -> None:
    with pytest.raises(CoopenvError) as caught:
        load_scenario(name)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_paths_are_no_scenes() -> None:
    assert is_scene("lane:8") and not is_scene("lane:8.toml") and not is_scene("lane:a/b") and not is_scene("lane")


def test_names_of_scenes_are_known_without_the_simulation() -> None:
    assert tuple(SCENES) == installation.SCENES and [row["name"] for row in scene_rows()] == [
        f"{kind}:N" for kind in SCENES
    ]
    assert not set(SCENES) & set(list_envs())


def test_the_text_is_a_file_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(scene_text("tree:9"), encoding="utf-8")
    assert load_scenario(file) == made("tree:9")
    file = environment_file("tree:9")
    assert file.name == "tree_9.toml" and tomllib.loads(file.text or "") == tomllib.loads(scene_text("tree:9"))


def test_as_many_vehicles_as_allowed_run() -> None:
    """From 65 on they keep their neighbours alone, which changes nothing."""
    recording = record(made("ring:65", horizon=0.2), 0)
    assert recording.bearings.shape[1:3] == (65, 68)
    assert recording.visible[1:].sum(axis=2).min() == 3
    everything = record(made("ring:65", horizon=0.2, **{"topology.most_nearby": None}), 0)
    np.testing.assert_array_equal(recording.bearings, everything.bearings)
    np.testing.assert_array_equal(recording.inbox_tick, everything.inbox_tick)
    assert len(made(f"ring:{MOST_VEHICLES}").vehicles) == MOST_VEHICLES


@pytest.mark.parametrize("name", ["lane:6", "roots:6", "tree:7", "random:6,seed=4", "ring:4", "road:5", "crossroad:5"])
def test_bearings_locate_every_vehicle(name: str) -> None:
    """The bound falls below a quarter of a metre within seconds: the bearings of every vehicle suffice."""
    bound = cramer_rao_ancestors(record(made(name, horizon=8.0, rates__camera=20.0, rates__odometry=20.0), 0))
    assert bound.position[0].min() > 0.7 and bound.position[-1].max() < 0.3


STEP = 0.1
"""m from one point of a line of sight to the next."""


class Traffic(NamedTuple):
    """Vehicles by the file alone: (N, 2) starts in m, (N, 2) velocities in m/s, and (N, 2) half sizes along x and y."""

    start: Array
    velocity: Array
    half: Array

    @classmethod
    def of(cls, name: str) -> Traffic:
        """Read the file of a scene, whose vehicles go along an axis each."""
        vehicles = tomllib.loads(scene_text(name))["vehicles"]
        yaw = np.array([v["initial_pose"].get("yaw", 0.0) for v in vehicles])
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        assert np.allclose(np.abs(along).max(axis=1), 1.0, atol=1e-5)
        assert all(v["motion"]["linear"][1:] == [0.0, 0.0] and "angular" not in v["motion"] for v in vehicles)
        speed = np.array([v["motion"]["linear"][0] for v in vehicles])
        size = np.array([v["body"]["size"][:2] for v in vehicles])
        across = np.abs(along[:, :1]) < 0.5
        start = np.array([v["initial_pose"]["position"][:2] for v in vehicles])
        return cls(start, speed[:, None] * along, np.where(across, size[:, ::-1], size) / 2)

    def least_gap(self, time: float) -> float:
        """Return the least gap of two boxes at a time in s, m; below 0 where they overlap."""
        at = self.start + time * self.velocity
        gap = (np.abs(at[:, None] - at) - self.half[:, None] - self.half).max(axis=-1)
        return float(gap[~np.eye(len(at), dtype=bool)].min())


@settings(max_examples=12, deadline=None)
@given(names(["road", "crossroad"]))
def test_vehicles_never_touch(name: str) -> None:
    traffic = Traffic.of(name)
    assert min(traffic.least_gap(t) for t in np.arange(0.0, 60.0, 0.05)) > 0.4


@pytest.mark.parametrize("kind", ["road", "crossroad"])
def test_separations_grow_with_speed(kind: str) -> None:
    """Of two vehicles in a lane, the gap is at least the headway of 1.5 s, and both are as fast."""
    for speed in (2.0, 10.0, 25.0, 50.0):
        traffic, pairs = Traffic.of(f"{kind}:12,speed={speed}"), 0
        for i, j in np.argwhere(~np.eye(12, dtype=bool)):
            fast = np.linalg.norm(traffic.velocity[i])
            ahead = traffic.start[j] - traffic.start[i]
            along = float(ahead @ traffic.velocity[i] / fast)
            same = np.allclose(traffic.velocity[i], traffic.velocity[j]) and np.linalg.norm(ahead) < along + 0.01
            pairs += same
            assert not same or along - 5.5 >= 1.5 * fast
        assert pairs > 10


@settings(max_examples=8, deadline=None)
@given(st.integers(2, 20), SPEEDS, st.integers(1, 2))
def test_landmarks_are_in_range_for_fifty_seconds(vehicles: int, speed: float, lanes: int) -> None:
    for name in (f"road:{vehicles},speed={speed},lanes={lanes}", f"crossroad:{vehicles},speed={speed}"):
        file, traffic = tomllib.loads(scene_text(name)), Traffic.of(name)
        marks = np.array([mark["position"][:2] for mark in file["landmarks"]])
        for t in np.linspace(0.0, file["horizon"], 26):
            far = np.linalg.norm((traffic.start + t * traffic.velocity)[:, None] - marks, axis=-1)
            assert (far < file["camera"]["range"]).any(axis=1).all()


def hit(start: Array, end: Array, low: Array, high: Array, margin: float) -> bool:
    """Return whether a line from start to end meets a box that is larger by a margin, m."""
    share = np.linspace(0.0, 1.0, math.ceil(np.linalg.norm(end - start) / STEP))[:, None]
    points = start + share * (end - start)
    return bool(((points > low - margin) & (points < high + margin)).all(axis=1).any())


def sights(name: str, ticks: NDArray[np.int64]) -> tuple[Recording, dict[bool, int]]:
    """Compare what is visible at some ticks with lines of sight; return the record, and how many are free or not."""
    scenario = made(name)
    r, file = record(scenario, 3), tomllib.loads(scene_text(name))
    origin = np.array(file.get("map", {}).get("origin", [0.0, 0.0, 0.0]))
    size = np.array([v["body"]["size"] for v in file["vehicles"]])
    walls = [(np.array(b["center"]) - origin, np.array(b["size"]) / 2) for b in file.get("obstacles", ())]
    L, N, found = len(file["landmarks"]), len(size), {True: 0, False: 0}
    for k in ticks:
        p, R = r.truth.position[k], r.truth.rotation[k]
        cars = [(p[n] + [0, 0, size[n, 2] / 2], np.abs(R[n] @ size[n]) / 2) for n in range(N)]
        targets = np.concatenate([r.landmarks[k], p + np.array([0.0, 0.0, 1.0])])
        for i in range(N):
            eye = p[i] + R[i] @ [0.5, 0.0, 1.3]
            for n in range(L + i):
                others = [*walls, *(cars[j] for j in range(N) if j not in (i, n - L))]
                far = float(np.linalg.norm(targets[n] - eye))
                near = far < 80.0
                hidden = near and any(hit(eye, targets[n], c - h, c + h, -STEP) for c, h in others)
                free = near and not any(hit(eye, targets[n], c - h, c + h, STEP) for c, h in others)
                if hidden or free or not near:
                    assert r.visible[k, i, n] == free, (k, i, n)
                found[free] += near and (hidden or free)
    return r, found


def test_vehicles_hide_what_is_behind_them() -> None:
    _, found = sights("road:8,speed=12", np.arange(20, 500, 90))
    assert found[True] > 50 and found[False] > 10


def test_buildings_hide_the_other_road() -> None:
    """In the crossing both roads are in view, before it only the own one."""
    r, found = sights("crossroad:6", np.arange(20, 260, 30))
    assert found[True] > 50 and found[False] > 50
    first, south = 0, len(r.landmarks[0]) + 2  # vehicle_1 goes east, vehicle_3 north, and arrives 2.2 s later
    seen = r.visible[:, 2, len(r.landmarks[0]) + first]
    along = r.truth.position[:, 0, 0]
    assert not seen[(along > -60.0) & (along < -12.0)].any() and seen[np.abs(along) < 2.0].all()
    assert not r.visible[:, first, south].any()  # acyclic: no vehicle measures a later one


def test_names_of_landmarks_and_the_order_of_vehicles() -> None:
    """The front vehicle is the first of a road, and pairs from opposite sides take turns in the crossing."""
    ahead = [vehicle.position[0] for vehicle in road(9, 20.0, 2).vehicles]
    assert ahead == sorted(ahead, reverse=True)
    yaws = [round(vehicle.yaw / math.pi * 2) for vehicle in crossroad(6, 10.0).vehicles]
    assert yaws == [0, 2, 1, 3, 0, 2]
    assert {vehicle.velocity[0] for vehicle in road(9, 20.0, 2).vehicles} == {20.0, 22.0}
    assert {vehicle.velocity[0] for vehicle in road(9, 20.0, 1).vehicles} == {20.0}


@pytest.mark.parametrize("name", ["road:4", "crossroad:4"])
def test_filters_follow_vehicles_at_speed(name: str) -> None:
    """Both filters fall from a metre to decimetres, and the paper's observer, which is slower, to a metre or two."""
    recording = record(made(name, horizon=9.0), 1)
    for observer, bound in (("robust", 0.25), ("schmidt_kalman", 0.25), ("riccati", 5.0)):
        result = run(observer, recording)
        assert not result.failure and (result.position_rmse(6.0) < bound).all(), (observer, result.position_rmse(6.0))
