"""SUMO moves the cars, and this project's sensors, radio and observers are on them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.estimation import Sight
from tests.helpers.sumo import CROSSING, EXACT, grid, own_simulation

pytest.importorskip("libsumo", reason="needs the extra sumo")

FRONT = 1.35 + 2.5
"""m from the origin of a car to its front, as its body says."""


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return grid(tmp_path_factory.mktemp("city"), count=25)


def engine_of(name: str | Path = CROSSING, worlds: int = 1, **overrides: Any) -> Engine:
    changed = {key.replace("__", "."): value for key, value in overrides.items()}
    return Engine(coopenv.load_scenario(name, changed), worlds, "float64")


def poses_of(engine: Engine, world: int = 0) -> np.ndarray:
    """Return x, y (map, m), heading (rad) and presence (N, 4) of the vehicles."""
    L, view = engine.world.model.landmarks, engine.view
    R = view("rotation")[world, L:]
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.column_stack([view("position")[world, L:, :2], heading, view("present")[world, L:]])


def test_traffic_is_where_a_simulation_of_ones_own_has_it(city: Path) -> None:
    """The same network, routes and seed in another process, without anything of coopenv."""
    engine = engine_of(city)
    engine.reset([3])
    for _ in range(20):
        engine.step(ticks=1)
    program = engine.world.programs[0]
    there = own_simulation(city.parent, program._seed, warm_up=30.0, steps=20)
    origin = np.array(engine.world.scenario.map.origin[:2])
    for x, y, heading, present in poses_of(engine):
        front = np.array([x, y]) + origin + FRONT * np.array([np.cos(heading), np.sin(heading)])
        nearest = min(there.values(), key=lambda row: np.hypot(*(row[:2] - front)))
        assert present == 0 or np.hypot(*(nearest[:2] - front)) < 1e-9
        assert present == 0 or np.cos(heading - np.radians(90.0 - nearest[2])) == pytest.approx(1.0)
    half, seen = engine.view("traffic_half")[0], engine.view("traffic_position")[0]
    count = int((half[:, 0] > 0).sum())
    assert count > 0 and count + int(poses_of(engine)[:, 3].sum()) == len(there)
    for place in seen[:count, :2] + origin:  # the middle of a box is half a length behind its front
        middles = [row[:2] - 2.5 * np.array([np.sin(a := np.radians(row[2])), np.cos(a)]) for row in there.values()]
        assert min(np.hypot(*(middle - place)) for middle in middles) < 1e-9


@pytest.mark.parametrize("rate", [30.0, 60.0])
def test_between_two_steps_traffic_is_on_the_way_from_one_to_the_next(city: Path, rate: float) -> None:
    """Camera rates of which a period is no whole number of milliseconds."""
    ticks, period = 20, 1000.0 / rate
    engine = engine_of(city, rates__camera=rate, rates__decision=rate)
    engine.reset([3])
    for _ in range(ticks):
        engine.step(ticks=1)
    step, seed = int(period), engine.world.programs[0]._seed
    whole, share = divmod(ticks * period / step, 1.0)
    before, after = (
        own_simulation(city.parent, seed, warm_up=30.0, steps=int(whole) + k, step=step / 1000.0) for k in (0, 1)
    )
    fronts = [b[:2] + share * (after[name][:2] - b[:2]) for name, b in before.items() if name in after]
    origin = np.array(engine.world.scenario.map.origin[:2])
    there = [row for row in poses_of(engine) if row[3] != 0]
    assert len(there) > 10
    for x, y, heading, _ in there:
        front = np.array([x, y]) + origin + FRONT * np.array([np.cos(heading), np.sin(heading)])
        assert min(np.hypot(*(place - front)) for place in fronts) < 1e-9


@pytest.mark.parametrize("rates", [(10.0, 100.0, 5.0), (30.0, 300.0, 10.0)])
def test_odometry_is_that_of_the_motion(city: Path, rates: tuple[float, float, float]) -> None:
    named = dict(zip(("rates__camera", "rates__odometry", "rates__decision"), rates, strict=True))
    engine = engine_of(city, **EXACT, **named, observer__name="dead_reckoning")
    engine.reset([1])
    for _ in range(40):
        engine.step()
    there = poses_of(engine)[:, 3] > 0
    assert there.sum() > 10 and engine.view("speed")[0, there].max() > 5.0
    assert engine.view("position_error")[0, there].max() < 1e-6


def driven(engine: Engine) -> list[int]:
    return [i for i, vehicle in enumerate(engine.world.scenario.vehicles) if vehicle.motion.kind == "driven"]


def test_driven_vehicles_are_the_bicycles_of_the_simulation() -> None:
    """From the same pose and speed, under the same commands, a car of `simulated` comes to the same place."""
    engine = engine_of(**EXACT, termination__collision=False)
    engine.reset([2])
    i = driven(engine)[0]
    start, speed = poses_of(engine)[i], float(engine.view("speed")[0, i])
    scenario = engine.world.scenario.model_dump(mode="json", exclude_unset=True)
    alone = coopenv.scenario.parse_scenario(
        {
            **{key: scenario[key] for key in ("title", "horizon", "rates", "dynamics", "action", "landmarks", "map")},
            "vehicles": [
                {
                    "initial_pose": {"position": [*(start[:2] + scenario["map"]["origin"][:2]), 0.0], "yaw": start[2]},
                    "motion": {"kind": "driven", "initial_speed": speed},
                }
            ],
        },
        "alone",
    )
    other = Engine(alone, 1, "float64")
    other.reset([0])
    actions = np.random.default_rng(0).uniform(-0.2, 0.6, (15, 1, len(engine.world.scenario.vehicles), 2))
    for action in actions:
        engine.step(action)
        other.step(action[:, i : i + 1])
    assert_allclose(poses_of(engine)[i], poses_of(other)[0], atol=1e-6)


def test_a_vehicle_changes_between_actions_and_sumo() -> None:
    engine = engine_of(termination__collision=False, termination__after_arrival="park", v2x__loss=0.0)
    engine.reset([2])
    program, name, i = engine.world.programs[0], "vehicle_7", 6
    actions = np.zeros((1, 8, 2))
    actions[..., 0] = -1.0  # stand still
    for _ in range(15):
        engine.step(actions)
    assert abs(engine.view("speed")[0, i]) < 0.01
    stood = poses_of(engine)[i]
    program.release(name)
    for _ in range(25):
        before = poses_of(engine)[i]
        engine.step(actions, ticks=1)
        assert np.hypot(*(poses_of(engine)[i, :2] - before[:2])) < 1.5  # no jump
    assert engine.view("speed")[0, i] > 2.0, "SUMO drives on"
    moved = poses_of(engine)[i, :2] - stood[:2]
    assert moved[1] > 2.0 and abs(moved[0]) < 0.2, "along its route to the north, in its lane"
    program.take(name)
    engine.step(actions, ticks=1)
    speed = float(engine.view("speed")[0, i])
    for _ in range(10):
        engine.step(actions)
    assert abs(engine.view("speed")[0, i]) < 0.01 and speed > 1.0
    for wrong in (program.take, program.release):
        with pytest.raises(CoopenvError, match=r"unknown vehicle 'vehicle_9' \(did you mean 'vehicle_"):
            wrong("vehicle_9")


def test_sumo_sees_driven_vehicles(tmp_path: Path) -> None:
    """A car of SUMO's that comes from behind stops behind a driven one that stands in its lane."""
    path = grid(tmp_path, count=1)
    edges = 'edges="A0A1 A1A2"'
    tmp_path.joinpath("grid.rou.xml").write_text(
        f'<routes><route id="way" {edges}/><vehicle id="behind" depart="20"><route {edges}/></vehicle></routes>'
    )
    vehicles = [{"motion": {"kind": "driven"}, "routes": ["way"]}]
    car = {"max_speed": 10.0, "max_acceleration": 4.0, "wheelbase": 2.7}
    engine = engine_of(path, vehicles=vehicles, dynamics=car, termination__collision=False, sumo__warm_up=1.0)
    engine.reset([1])
    for k in range(200):
        engine.step(np.array([[[0.0 if k < 50 else -1.0, 0.0]]]))
    half, place = engine.view("traffic_half")[0, 0], engine.view("traffic_position")[0, 0]
    gap = poses_of(engine)[0, 1] - 1.15 - (place[1] + half[0])
    assert half[0] == 2.5 and 0.5 < gap < 5.0
    assert engine.view("collided")[0, 0] == 0


def test_a_city_that_begins_in_the_morning(city: Path, tmp_path: Path) -> None:
    """Its configuration states the begin; without it, the error does."""
    folder = city.parent
    late = folder.joinpath("grid.rou.xml").read_text()
    for k in range(60, -1, -1):
        late = late.replace(f'depart="{k}.', f'depart="{25205 + k}.')
    (tmp_path / "late.rou.xml").write_text(late)
    files = f'<net-file value="{folder / "grid.net.xml"}"/><route-files value="late.rou.xml"/>'
    (tmp_path / "city.sumocfg").write_text(f'<c><i>{files}</i><t><begin value="7:00:00"/></t></c>')
    engine = engine_of(city, sumo__net=str(tmp_path / "city.sumocfg"), sumo__routes=[str(tmp_path / "late.rou.xml")])
    engine.reset([1])
    assert engine.world.scenario.sumo.begin == 25200.0 and poses_of(engine)[:, 3].all()
    with pytest.raises(CoopenvError, match=r"SUMO has 0 after .*; the first of 1\d\d departs at 25,205 s, .* = 25205"):
        engine_of(city, sumo__routes=[str(tmp_path / "late.rou.xml")]).reset([1])


def test_left_hand_traffic_has_its_posts_beside_the_road(tmp_path: Path) -> None:
    scenarios = []
    for side in ((), ("--lefthand",)):
        path = grid(tmp_path, 4, 2, "--default.lanenumber", "2", *side)
        scenarios.append(coopenv.load_scenario(path))
    for scenario in scenarios:
        for post in scenario.landmarks:
            edges = [np.array([road.start, road.end]) for road in scenario.roads]
            middles = np.concatenate([np.linspace(start, end, 400) for start, end in edges])
            assert np.hypot(*(middles - post.position[:2]).T).min() > 1.6  # half a lane
    Engine(scenarios[1], 1).reset([1])


def test_worlds_of_a_batch_are_those_of_their_seeds_and_run_beside_each_other() -> None:
    batch = engine_of(worlds=2)
    batch.reset([7, 8])
    processes = [program._process.pid for program in batch.world.programs]
    assert len(set(processes)) == 2 and os.getpid() not in processes
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 1, 8, 2))
    for action in actions:
        batch.step(np.tile(action, (2, 1, 1)))
    for world, seed in enumerate((7, 8)):
        single = engine_of()
        for _ in range(2):  # a process that has simulated before gives the same
            single.reset([seed])
            for action in actions:
                single.step(action)
            for field in ("position", "estimate_position", "observation", "traffic_position"):
                assert np.array_equal(single.view(field)[0], batch.view(field)[world]), field
    assert not np.array_equal(*batch.view("position"))


def test_buildings_hide_and_parked_vans_occlude() -> None:
    engine = engine_of(camera__miss_probability=0.0)
    seen = set()
    for seed in range(4):
        engine.reset([seed])
        for _ in range(25):
            engine.step(np.full((1, 8, 2), [0.0, 0.0]))
            seen |= set(np.unique(engine.view("sight")).tolist())
    assert {Sight.VISIBLE, Sight.OCCLUDED_BY_BUILDING, Sight.OCCLUDED_BY_BODY} <= seen


def test_the_end_of_sumo_is_one_line_and_the_next_reset_begins_anew() -> None:
    env = coopenv.parallel_env(CROSSING)
    env.reset(seed=1)
    first = env.step({agent: np.zeros(2) for agent in env.agents})
    os.kill(env.engine.world.programs[0]._process.pid, signal.SIGKILL)
    with pytest.raises(CoopenvError, match=r"^SUMO was ended by SIGKILL 0\.\d s after the reset$"):
        for _ in range(3):
            env.step({agent: np.zeros(2) for agent in env.agents})
    env.reset(seed=1)
    again = env.step({agent: np.zeros(2) for agent in env.agents})
    assert all(np.array_equal(first[0][agent], again[0][agent]) for agent in first[0])
    process = env.engine.world.programs[0]._process
    env.close()
    assert process.poll() is not None
    with pytest.raises(CoopenvError, match=r"^SUMO is not running: reset\(\) starts it$"):
        env.step({agent: np.zeros(2) for agent in env.agents})


def test_sumo_ends_with_the_program_that_has_started_it() -> None:
    code = (
        "import coopenv, os; env = coopenv.parallel_env('sumo_crossing'); env.reset(seed=0);"
        "print(env.engine.world.programs[0]._process.pid, flush=True); os._exit(0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    pid = int(done.stdout.split()[-1])
    for _ in range(100):
        if not Path(f"/proc/{pid}").exists() or " Z " in Path(f"/proc/{pid}/stat").read_text():
            return
        os.system("sleep 0.1")
    raise AssertionError("it still runs")


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        ({"sumo.net": "nowhere.net.xml"}, r"sumo\.net: '.*nowhere\.net\.xml': No such file"),
        ({"sumo.additional": ["nowhere.xml"]}, r"sumo\.additional: '.*nowhere\.xml': No such file"),
        ({"sumo.nets": "a"}, r"sumo\.nets: unknown key \(did you mean 'net'\?\)"),
        ({"sumo.options": {"step-length": 0.05}}, r"options\.step-length: follows from rates\.camera; leave this out"),
        ({"sumo.options": {"no-such-option": 1}}, "SUMO, 0 s after the reset: .*no-such-option"),
        ({"sumo.options": {"scale": [1, 2]}}, r"'scale': '1,2' is not a valid float"),
        ({"rates.camera": 2e3, "rates.decision": 5.0}, r"rates\.camera: SUMO's shortest step is 1 ms, not 0\.5 ms"),
        ({"sumo.options": {"begin": 60.0}}, r"options\.begin: follows from sumo\.begin; leave this out"),
        ({"vehicles.6.routes": ["south_nort"]}, r"vehicles\.6\.routes: unknown route 'south_nort'; known: west_east"),
        ({"vehicles.6.routes": ["south_north", "west_east"]}, r"vehicles\.6: SUMO needs one of its routes"),
        ({"vehicles.0.motion": {"kind": "static"}}, r"motion\.kind: 'static' is not known to SUMO; known: driven"),
        ({"sumo.warm_up": 0.0}, "vehicles: 6 are in traffic, but SUMO has"),
        ({"sumo.most_vehicles": 0}, r"sumo\.most_vehicles: 0 are too few, there are 2 on the road"),
    ],
)
def test_mistakes_are_one_line(overrides: dict[str, Any], why: str) -> None:
    with pytest.raises(CoopenvError, match=why) as caught:
        coopenv.parallel_env(CROSSING, overrides=overrides).reset(seed=0)
    assert "\n" not in str(caught.value)


def test_without_sumo_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coopenv.sumo.program.find_spec", lambda name: None)
    with pytest.raises(CoopenvError, match=r"^backend 'sumo' needs SUMO, which is not installed: pip install"):
        coopenv.parallel_env(CROSSING)


def test_states_of_others_are_refused() -> None:
    env = coopenv.parallel_env(CROSSING)
    env.reset(seed=1)
    state = env.get_state()
    before, good = env.engine.view("position").copy(), state["programs"][0]
    inf = [np.full((1, 4), np.inf)]
    bad = [{**good, "seed": "1"}, {**good, "moved": [np.zeros(3)]}, {**good, "moved": inf}, {**good, "taken": None}]
    for wrong in (None, [], [1], *([each] for each in bad)):
        with pytest.raises(CoopenvError, match="programs: expected 1 of backend 'sumo'"):
            env.set_state({**state, "programs": wrong})
        assert np.array_equal(env.engine.view("position"), before)
    env.set_state(state)
