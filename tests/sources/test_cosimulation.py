"""A program of the user's own moves the vehicles; what a scenario takes from SUMO's files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from tests.helpers.plugins import install

CODE = '''
import numpy as np
from coopenv.sources.cosimulation import Poses, TrafficProgram


class Circle(TrafficProgram):
    """The first vehicle goes round on a circle; the second is driven by actions, and a box stands at the origin."""

    def __init__(self, scenario, radius=10.0):
        self.radius, self.rate, self.k = radius, scenario.rates.camera, 0

    def reset(self, seed):
        self.k = 0

    def command(self, now):
        self.k += 1
        if self.k == 13:
            raise ValueError("thirteen")

    def poses(self):
        angle = 0.5 * self.k / self.rate
        xy = np.array([[self.radius * np.cos(angle), self.radius * np.sin(angle)], [0.0, -20.0]])
        zeros = np.zeros(2)
        return Poses(
            xy, np.array([angle + np.pi / 2, 0.0]), zeros, zeros, zeros, zeros,
            np.array([[0.0, 0.0, 1.0]]), np.zeros(1), np.ones((1, 3)), driven=np.array([False, True]),
        )


class NoProgram:
    def __init__(self, scenario):
        pass
'''


@pytest.fixture
def own(tmp_path: Path) -> dict[str, Any]:
    (tmp_path / "mine.py").write_text(CODE)
    return {
        "title": "circle",
        "horizon": 2.0,
        "backend": "program",
        "program": {"code": f"{tmp_path}/mine.py:Circle", "options": {"radius": 5.0}, "most_vehicles": 1},
        "rates": {"camera": 10.0, "decision": 10.0, "odometry": 100.0},
        "noise": {"enabled": False},
        "observer": {"name": "dead_reckoning"},
        "landmarks": [{"name": n, "position": p} for n, p in (("a", [9, 9, 2]), ("b", [-9, 9, 2]), ("c", [9, -9, 2]))],
        "vehicles": [{"motion": {"kind": "traffic"}}, {"motion": {"kind": "driven"}}],
    }


def test_a_program_of_another_package_is_a_backend_by_its_name(
    own: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = {"orbit": "orbits:Circle", "lost": "no_such_module:Circle"}
    install(tmp_path, monkeypatch, "orbits", CODE, {"coopenv.cosimulators": points})
    section = {**own.pop("program")["options"], "most_vehicles": 1}
    scenario = coopenv.scenario.parse_scenario({**own, "backend": "orbit", "orbit": section}, "circle")
    assert scenario.program is not None and scenario.program.most_vehicles == 1
    env = coopenv.parallel_env(scenario, dtype="float64")
    env.reset(seed=0)
    env.step({agent: np.array([1.0, 0.0]) for agent in env.agents})
    assert env.engine.view("position")[0, -2, :2] == pytest.approx([5.0 * np.cos(0.05), 5.0 * np.sin(0.05)])
    with pytest.raises(CoopenvError, match=r"'no_such_module:Circle' cannot be loaded: ModuleNotFoundError"):
        coopenv.parallel_env(coopenv.scenario.parse_scenario({**own, "backend": "lost"}, "circle"))


def test_a_program_moves_what_it_does_not_leave_to_actions(own: dict[str, Any]) -> None:
    env = coopenv.parallel_env(coopenv.scenario.parse_scenario(own, "circle"), dtype="float64")
    env.reset(seed=0)
    for k in range(1, 12):
        *_, infos = env.step({agent: np.array([1.0, 0.0]) for agent in env.agents})
        place = infos["vehicle_2"]["truth"]["position"]
        assert env.engine.view("position")[0, -2, :2] == pytest.approx([5.0 * np.cos(0.05 * k), 5.0 * np.sin(0.05 * k)])
        assert env.engine.view("position_error")[0, 0] < 1e-9  # its odometry is that of an arc
    assert env.possible_agents == ["vehicle_2"] and place[0] > 0.3 and infos["vehicle_2"]["position_error"] < 0.01
    assert env.engine.view("traffic_half")[0].tolist() == [[1.0, 1.0, 1.0]]
    twin = coopenv.parallel_env(env.scenario, dtype="float64")
    twin.reset(seed=5)
    twin.set_state(env.get_state())
    assert twin.engine.world.programs[0].k == 11
    with pytest.raises(CoopenvError, match=r"backend 'program' failed at mine\.py:\d+: ValueError: thirteen"):
        for _ in range(2):
            env.step({agent: np.zeros(2) for agent in env.agents})


def test_programs_that_cannot_be_are_one_line(own: dict[str, Any]) -> None:
    code = own["program"]["code"]
    for change, why in (
        ({"code": code.replace("Circle", "Circel")}, "no 'Circel' in .*did you mean 'Circle'"),
        ({"code": code.replace("Circle", "NoProgram"), "options": {}}, r"program\.code: .* makes no coopenv\.sources"),
        ({"options": {"radios": 1.0}}, r"program\.code: .*: TypeError: .*radios"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.parallel_env(coopenv.scenario.parse_scenario({**own, "program": {**own["program"], **change}}, "c"))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("poses.xy[0] = np.nan", r"poses: xy: expected finite numbers of shape \(2, 2\), got others"),
        ("poses = replace(poses, xy=poses.xy[:1])", r"poses: xy: expected .* shape \(2, 2\), got \(1, 2\)"),
        ("poses = replace(poses, speed=np.zeros((2, 1)))", r"poses: speed: expected .* \(2,\), got \(2, 1\)"),
        ("poses = replace(poses, traffic_half=np.ones((2, 3)))", r"program\.most_vehicles: 1 are too few, there are 2"),
        ("poses = None", r"Changed\.poses: expected Poses, got None"),
    ],
)
def test_poses_that_are_none_are_one_line(own: dict[str, Any], tmp_path: Path, change: str, why: str) -> None:
    more = f"""
from dataclasses import replace

class Changed(Circle):
    def poses(self):
        poses = super().poses()
        {change}
        return poses
"""
    (tmp_path / "changed.py").write_text(CODE + more)
    program = {**own["program"], "code": f"{tmp_path}/changed.py:Changed"}
    env = coopenv.parallel_env(coopenv.scenario.parse_scenario({**own, "program": program}, "circle"))
    with pytest.raises(CoopenvError, match=why):
        env.reset(seed=0)


def test_other_bodies_may_be_fewer_than_there_can_be(own: dict[str, Any]) -> None:
    program = {**own["program"], "most_vehicles": 3}
    env = coopenv.parallel_env(coopenv.scenario.parse_scenario({**own, "program": program}, "circle"))
    env.reset(seed=0)
    assert env.engine.view("traffic_half")[0].tolist() == [[1.0] * 3, [0.0] * 3, [0.0] * 3]


def test_routes_are_drawn_whatever_stood_there_before(own: dict[str, Any]) -> None:
    route = {"name": "way", "waypoints": [[0, 0], [20, 0]], "lateral_spread": 1.0}
    driven = {"motion": {"kind": "driven"}, "routes": ["way"], "body": {"size": [0.6, 0.3, 0.3]}}
    made = coopenv.scenario.parse_scenario({**own, "routes": [route], "vehicles": [own["vehicles"][0], driven]}, "c")
    engine, drawn = Engine(made, 1), []
    for _ in range(2):
        engine.reset([3])
        drawn.append(engine.view("route")[0, 1].copy())
    np.testing.assert_array_equal(*drawn)


def test_a_recording_names_no_code_and_reads_no_files(own: dict[str, Any]) -> None:
    from coopenv.scenario.own_terms import without_own_terms

    kept = coopenv.scenario.parse_scenario(without_own_terms(own), "circle")
    with pytest.raises(CoopenvError, match="not_recorded"):
        coopenv.parallel_env(kept)
    recorded = coopenv.load_scenario("sumo_crossing").model_dump(mode="json", exclude_unset=True)
    again = coopenv.scenario.parse_scenario(without_own_terms(recorded), "crossing")
    assert again.landmarks and again.sumo is not None and again.sumo.net == "not_recorded"


def test_a_count_stands_for_equal_vehicles(tmp_path: Path, own: dict[str, Any]) -> None:
    base = {"landmarks": own["landmarks"], "routes": [], "obstacles": []}
    vehicles = [{"initial_pose": {"position": [0, 0, 0]}}, {"count": 3, "initial_pose": {"position": [5, 0, 0]}}]
    moved = {"vehicles.2.initial_pose.position": [5, 5, 0], "vehicles.3.initial_pose.position": [5, 9, 0]}
    found = coopenv.load_scenario("busy_intersection", {**base, "vehicles": vehicles[:1]})
    assert len(found.vehicles) == 1
    path = tmp_path / "many.toml"
    path.write_text(
        'title = "many"\nhorizon = 1.0\nlandmarks = [{name = "a", position = [1, 2, 3]}]\n'
        "vehicles = [{initial_pose.position = [0, 0, 0]}, {count = 3, initial_pose.position = [5, 0, 0]}]\n"
    )
    found = coopenv.load_scenario(path, moved)
    assert [v.initial_pose.position[1] for v in found.vehicles if v.initial_pose] == [0.0, 0.0, 5.0, 9.0]
    for wrong in ("0", "true", "9999", '"3"'):
        path.write_text(path.read_text().replace("count = 3", f"count = {wrong}"))
        with pytest.raises(CoopenvError, match=r"many\.toml: vehicles\.1\.count: expected a whole number 1 to 4096"):
            coopenv.load_scenario(path)
        path.write_text(path.read_text().replace(f"count = {wrong}", "count = 3"))


NET = """<net>
 <location netOffset="0,0" convBoundary="0,0,100,40" origBoundary="0,0,100,40" projParameter="!"/>
 <edge id=":J_0" function="internal"><lane id=":J_0_0" index="0" length="10" speed="9" shape="50,10 55,15"/></edge>
 <edge id="in" from="A" to="J"><lane id="in_0" index="0" length="50" speed="9" width="4" shape="0,10 50,10"/></edge>
 <edge id="out" from="J" to="B"><lane id="out_0" index="0" length="25" speed="9" shape="55,15 55,40"/></edge>
 <junction id="A" type="dead_end" x="0" y="10" incLanes="" shape=""/>
 <junction id="B" type="dead_end" x="55" y="40" incLanes="out_0" shape=""/>
 <junction id="J" type="priority" x="52" y="12" incLanes="in_0" shape=""/>
 <connection from="in" to="out" fromLane="0" toLane="0" via=":J_0_0" dir="l" state="M"/>
 <connection from=":J_0" to="out" fromLane="0" toLane="0" dir="l" state="M"/>
</net>"""
SHAPES = """<additional>
 <poly id="house" type="building.flat" shape="10,20 30,20 30,30 10,30 10,20"><param key="height" value="7"/></poly>
 <poly id="corner" type="building" shape="60,0 80,0 80,10 70,10 70,20 60,20"/>
 <poly id="park" type="green" shape="0,0 1,0 1,1"/>
 <poi id="sign" type="landmark" x="20" y="5"/>
 <poi id="shop" type="shop" x="21" y="5"/>
 <vehicle id="way" depart="0"><route edges="in out"/></vehicle>
</additional>"""


def sumo_scenario(folder: Path, **changes: Any) -> dict[str, Any]:
    (folder / "a.net.xml").write_text(NET)
    (folder / "a.add.xml").write_text(SHAPES)
    return {
        "title": "corner",
        "horizon": 1.0,
        "backend": "sumo",
        "sumo": {"net": f"{folder}/a.net.xml", "additional": [f"{folder}/a.add.xml"]},
        "landmarks": [{"name": "own", "position": [1.0, 2.0, 3.0]}],
        "vehicles": [{"motion": {"kind": "driven"}, "routes": ["way"]}],
        **changes,
    }


def test_a_scenario_takes_the_map_of_files_of_sumo(tmp_path: Path) -> None:
    found = coopenv.scenario.parse_scenario(sumo_scenario(tmp_path), "corner")
    assert found.map.origin == (50.0, 20.0, 0.0)
    marks = {mark.name: mark.position for mark in found.landmarks}
    assert marks == {"own": (1.0, 2.0, 3.0), "post_1": (50.0, 7.5, 3.0), "poi_1": (20.0, 5.0, 3.0)}
    assert found.routes[0].waypoints == ((0.0, 10.0), (50.0, 10.0), (55.0, 15.0), (55.0, 40.0))
    house, *walls = found.obstacles
    assert (house.center, house.size, house.yaw) == ((20.0, 25.0, 3.5), (20.0, 10.0, 7.0), 0.0)
    assert sorted(wall.size[0] for wall in walls) == [10.0, 10.0, 10.0, 10.0, 20.0, 20.0]
    assert {(road.start, road.end, road.width) for road in found.roads} == {
        ((0.0, 10.0), (50.0, 10.0), 4.0),
        ((55.0, 15.0), (55.0, 40.0), 3.2),
    }
    again = coopenv.scenario.parse_scenario(found.model_dump(mode="json", exclude_unset=True), "corner")
    assert again == found
    raw = sumo_scenario(tmp_path)
    del raw["landmarks"]
    raw["sumo"]["included"] = True
    assert len(coopenv.scenario.parse_scenario(raw, "corner").landmarks) == 2, "a file without landmarks includes none"


@pytest.mark.parametrize(
    ("file", "text", "why"),
    [
        ("a.net.xml", "<net>", r"sumo\.net: a\.net\.xml: not XML"),
        ("a.net.xml", "<routes/>", r"sumo\.net: a\.net\.xml: no roads in it; expected a network"),
        ("a.net.xml", NET.replace('id="in" ', ""), r"sumo\.net: a\.net\.xml: an element lacks or spoils an attribute"),
        ("a.net.xml", NET.replace("</net>", '<edge id="x" from="A" to="J"/></net>'), r"a\.net\.xml: .*"),
        ("a.net.xml", NET.replace("0,10 50,10", "50,10"), r"a\.net\.xml: .*edge 'in' needs lanes of two"),
        ("a.net.xml", NET.replace("0,10 50,10", ""), r"a\.net\.xml: .*edge 'in' needs lanes of two"),
        ("a.net.xml", NET.replace("0,10 50,10", "50,10 50,10"), r"a\.net\.xml: .*edge 'in' needs lanes of two"),
        ("a.net.xml", NET.replace('via=":J_0_0"', 'via=":K_0"'), r"sumo\.net: a\.net\.xml: .*':K_0'"),
        (
            "a.net.xml",
            NET.replace('toLane="0" dir="l" state="M"', 'toLane="0" via=":J_0_0" dir="l"'),
            r"sumo\.net: a\.net\.xml: .*lane ':J_0_0' leads to itself",
        ),
        ("a.add.xml", SHAPES.replace('x="20" ', 'lon="2" '), r"sumo\.additional: a\.add\.xml: an element lacks"),
        ("a.add.xml", SHAPES.replace("in out", "in off"), r"sumo\.routes: route 'way': the network has no edge 'off'"),
        ("a.add.xml", SHAPES.replace("in out", "out in"), r"sumo\.routes: route 'way': no way from edge 'out' to 'in'"),
    ],
)
def test_files_of_sumo_that_are_wrong_are_one_line(tmp_path: Path, file: str, text: str, why: str) -> None:
    raw = sumo_scenario(tmp_path)
    (tmp_path / file).write_text(text)
    with pytest.raises(CoopenvError, match=why):
        coopenv.scenario.parse_scenario(raw, "corner")


def test_vehicles_that_a_program_moves_measure_with_sensors(own: dict[str, Any]) -> None:
    sensors = [{"kind": kind, "towards": ["vehicles"]} for kind in ("range", "tests.helpers.doppler:Doppler")]
    engine = Engine(coopenv.scenario.parse_scenario({**own, "sensors": sensors}, "circle"), 1, "float64")
    engine.reset([0])
    for k in range(1, 6):
        engine.step(np.zeros((1, 2, 2)))
        readings = engine.world.sensed(0, k).readings  # type: ignore[attr-defined]
        R, velocity, position = (engine.view(name)[0, -2:] for name in ("rotation", "velocity", "position"))
        line = position[0] - position[1]
        assert readings["range"][1, 3] == pytest.approx(np.linalg.norm(line))
        growing = line @ (R[0] @ velocity[0] - R[1] @ velocity[1]) / np.linalg.norm(line)
        assert readings["doppler"][1, 3] == pytest.approx(growing)
