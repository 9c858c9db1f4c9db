"""highway-env moves the cars, and this project's sensors, radio and observers are on them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.estimation import Outcome, Sight

pytest.importorskip("highway_env", reason="needs the extra highway")

UNCONNECTED = {"highway.most_vehicles": 40, "highway.config.spawn_probability": 0.02}
CROSSING, ROUNDABOUT = "highway_intersection", "highway_roundabout"
EXACT = {"noise.enabled": False, "vehicles.*.initial_estimate": {"position_radius": 0.0, "orientation_angle": 0.0}}


def engine_of(name: str, worlds: int = 1, **overrides: Any) -> Engine:
    scenario = coopenv.load_scenario(name, {key.replace("__", "."): value for key, value in overrides.items()})
    return Engine(scenario, worlds, "float64")


def road_of(engine: Engine, world: int = 0) -> Any:
    return engine.world.programs[world].environment.road


def test_cars_are_where_highway_env_has_them_with_y_up() -> None:
    engine = engine_of(CROSSING, **UNCONNECTED)
    engine.reset([5])
    vehicles = engine.view("actions").shape[1]
    engine.set_actions(np.full((1, vehicles, 2), [0.6, 0.1]))
    for _ in range(10):
        engine.step()
    L = engine.world.model.landmarks
    everybody = road_of(engine).vehicles
    places = {(round(float(car.position[0]), 6), round(float(-car.position[1]), 6)): car for car in everybody}
    assert len(everybody) > vehicles
    for i in range(vehicles):
        x, y, z = engine.view("position")[0, L + i].tolist()
        car = places.pop((round(x, 6), round(y, 6)))
        R = engine.view("rotation")[0, L + i]
        assert z == 0.0 and np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(
            np.arctan2(*-np.sin([car.heading]), np.cos(car.heading))
        )
        assert engine.view("speed")[0, i] == pytest.approx(car.speed)
    half, seen = engine.view("traffic_half")[0], engine.view("traffic_position")[0]
    assert (half[:, 0] > 0.0).sum() == len(places)
    for (x, y), car in places.items():
        k = int(np.argmin(np.linalg.norm(seen[:, :2] - (x, y), axis=1)))
        assert_allclose(seen[k], [x, y, 0.75], atol=1e-6)
        assert_allclose(half[k], [car.LENGTH / 2, car.WIDTH / 2, 0.75])


@pytest.mark.parametrize("dynamical", [False, True])
def test_odometry_is_that_of_the_motion(dynamical: bool) -> None:
    overrides = {
        **EXACT,
        "observer.name": "dead_reckoning",
        "highway.dynamical": dynamical,
        "termination.collision": False,
    }
    env = coopenv.parallel_env(ROUNDABOUT, dtype="float64", overrides=overrides)
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(30):
        *_, infos = env.step({agent: rng.uniform(-1.0, 1.0, 2) for agent in env.agents})
        for info in infos.values():
            assert info["position_error"] < 1e-7 and info["orientation_error"] < 1e-5


def test_commands_are_speeds_and_steering_to_the_left() -> None:
    env = coopenv.parallel_env(ROUNDABOUT, dtype="float64", overrides=EXACT)
    _, infos = env.reset(seed=1)
    assert infos["vehicle_4"]["truth"]["position"][1] < -40.0
    for _ in range(12):
        env.step({agent: np.array([-0.5, 0.0]) for agent in env.agents})
    assert env.engine.view("speed")[0, 3] == pytest.approx(3.0, abs=1e-6)
    *_, infos = env.step({agent: np.array([-0.5, 1.0]) for agent in env.agents})
    assert infos["vehicle_4"]["truth"]["angular_velocity"][2] > 0.2
    assert env.engine.view("turn")[0, 3] == pytest.approx(0.5)


def test_traffic_ignores_commands() -> None:
    moved = []
    for action in (-1.0, 1.0):
        engine = engine_of(ROUNDABOUT)
        engine.reset([4])
        for _ in range(5):
            engine.step(np.array([[[action] * 2] * 3 + [[0.0, 0.0]]]))
        moved.append(engine.view("position")[0, -4:].copy())
    assert_allclose(*moved)


def test_traffic_has_no_actions() -> None:
    env = coopenv.parallel_env(ROUNDABOUT)
    observations, _ = env.reset(seed=4)
    assert env.possible_agents == env.agents == [*observations] == ["vehicle_4"]
    with pytest.raises(CoopenvError, match="action for unknown agent 'vehicle_1'"):
        env.step(dict.fromkeys(("vehicle_1", "vehicle_4"), np.zeros(2)))


@pytest.mark.parametrize("name", [CROSSING, ROUNDABOUT])
def test_worlds_of_a_batch_are_those_of_their_seeds(name: str) -> None:
    batch = engine_of(name, 2)
    batch.reset([7, 8])
    vehicles = batch.view("actions").shape[1]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (15, 1, vehicles, 2))
    for action in actions:
        batch.step(np.tile(action, (2, 1, 1)))
    for world, seed in enumerate((7, 8)):
        single = engine_of(name)
        single.reset([seed])
        for action in actions:
            single.step(action)
        for field in ("position", "estimate_position", "observation", "traffic_position"):
            assert np.array_equal(single.view(field)[0], batch.view(field)[world]), field
    assert not np.array_equal(batch.view("position")[0, -vehicles:], batch.view("position")[1, -vehicles:])


def test_the_next_episode_is_another_one_and_a_mask_leaves_the_others() -> None:
    engine = engine_of(CROSSING, 2)
    engine.reset([7, 8])
    first = engine.view("position").copy()
    engine.reset(None, np.array([False, True]))
    assert np.array_equal(engine.view("position")[0], first[0])
    assert not np.array_equal(engine.view("position")[1], first[1])


def put_a_car(engine: Engine, x: float, y: float) -> None:
    """Put a car of highway-env's that stands across the road; x and y as on our map."""
    from highway_env.vehicle.kinematics import Vehicle

    road = road_of(engine)
    road.vehicles.append(Vehicle(road, [x, -y], heading=0.0, speed=0.0))


def test_other_traffic_hides_what_is_behind_it() -> None:
    overrides = {
        "landmarks": [{"name": n, "position": [2.0 + x, -29.0, 1.0]} for n, x in (("A", 0), ("B", -9), ("C", 9))]
    }
    seen = []
    for hidden in (False, True):
        engine = engine_of(
            ROUNDABOUT,
            camera__range=200.0,
            obstacles=[],
            camera__miss_probability=0.0,
            **overrides,
            highway__most_vehicles=40,
        )
        engine.reset([1])
        if hidden:
            put_a_car(engine, *(engine.view("position")[0, 3 + 3, :2] + (0.0, 8.0)))
        engine.set_actions(np.full((1, 4, 2), [-1.0, 0.0]))
        engine.step(ticks=1)
        seen.append(Sight(int(engine.view("sight")[0, 3, 0])))
    assert seen == [Sight.VISIBLE, Sight.OCCLUDED_BY_BODY]


def test_unconnected_traffic_is_measured_and_sends_nothing() -> None:
    """What cameras measure, and what the cars hide, is the same as with a radio."""
    given = {"camera.model": "omnidirectional", "camera.range": 300.0, "camera.miss_probability": 0.0, "obstacles": []}
    given["observation.include"] = ["sightings", "messages"]
    sight = []
    for connected in (True, False):
        overrides = {**given, "vehicles.vehicle_1.connected": connected}
        engine = Engine(coopenv.load_scenario(ROUNDABOUT, overrides), 1, "float64")
        engine.reset([1])
        engine.step(np.zeros((1, 4, 2)))
        sight.append(engine.view("sight")[0, 3].copy())
    assert np.array_equal(*sight) and sight[0][-4] == Sight.VISIBLE
    row = {name: engine.view("observation")[0, 3, field.slice] for name, field in engine.layout.items()}
    assert row["sighting_mask"][0] == 1.0 and np.linalg.norm(row["sighting"][:3]) == pytest.approx(1.0)
    assert row["message_mask"].tolist() == [0.0, 1.0, 1.0]


def test_to_touch_other_traffic_is_a_collision() -> None:
    engine = engine_of(ROUNDABOUT, highway__most_vehicles=40)
    engine.reset([1])
    L = engine.world.model.landmarks
    put_a_car(engine, *(engine.view("position")[0, L + 3, :2] + (0.0, 12.0)))
    engine.set_actions(np.full((1, 4, 2), [1.0, 0.0]))
    while engine.view("ended")[0, 3] == 0:
        engine.step()
    assert engine.view("ended")[0, 3] == 2 and engine.view("tick")[0] < 20


def test_a_vehicle_that_leaves_the_road_has_arrived() -> None:
    vehicles = [{"motion": {"kind": "driven"}}] + [{"motion": {"kind": "traffic"}}] * 2
    engine = engine_of(CROSSING, horizon=40.0, vehicles=vehicles)
    engine.reset([3])
    engine.set_actions(np.full((1, 3, 2), [-1.0, 0.0]))
    while not (arrived := engine.view("ended")[0] == Outcome.ARRIVED).any():
        engine.step()
    assert not arrived[0]


def test_a_plain_environment_in_the_same_program_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from highway_env.envs.intersection_env import IntersectionEnv
    from highway_env.vehicle.behavior import IDMVehicle

    places = []
    for name, value in (("DISTANCE_WANTED", 10.0), ("COMFORT_ACC_MAX", 3.0), ("COMFORT_ACC_MIN", -5.0)):
        monkeypatch.setattr(IDMVehicle, name, value)  # what they are before anybody has set them
    for other in (False, True):
        if other:
            IntersectionEnv()
            assert IDMVehicle.COMFORT_ACC_MAX == 6
        engine = engine_of(ROUNDABOUT)
        engine.reset([3])
        for _ in range(20):
            engine.step(np.zeros((1, 4, 2)))
        places.append(engine.view("position")[0].copy())
    assert np.array_equal(*places)


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        ({"backend": "simulated"}, 'highway: only with backend = "highway"'),
        ({"backend": "higway"}, "backend: Input should be 'simulated', 'highway', 'sumo' or 'program'"),
        ({"highway.id": "intersection-v9"}, r"highway\.id: highway-env has no environment 'intersection-v9' \(did you"),
        ({"highway.config.initial_vehicle_cout": 3}, r"highway\.config\.initial_vehicle_cout: unknown key"),
        ({"highway.config.other_vehicles_type": "no.such.Class"}, "highway: intersection-v0 cannot be made"),
        ({"highway.config.vehicle": {"bool": [[1]]}}, r"^highway\.config\.vehicle: unknown key; allowed: "),
        ({"highway.config.observation": {"type": "Kinematics"}}, r"config\.observation: follows from \[observation\]"),
        ({"highway.config.centering_position": {"x": 1}}, r"centering_position: expected a value like \[0\.5, 0\.6\]"),
        ({"highway.id": "two-way-v0"}, r"highway\.id: two-way-v0 takes no speed .*: its rewards need discrete"),
        ({"rates.camera": 12.5, "rates.decision": 12.5}, r"rates\.camera: highway-env steps a whole number"),
        ({"dynamics.wheelbase": 2.7}, r"dynamics\.wheelbase: highway-env has its own; allowed: max_acceleration"),
        ({"vehicles.0.initial_pose.position": [0.0, 0.0, 0.0]}, r"vehicles\.0\.initial_pose: highway-env draws it"),
        ({"vehicles.0.motion": {"kind": "static"}}, r"vehicles\.0\.motion\.kind: 'static' is not known to highway-env"),
        ({"vehicles": [{"motion": {"kind": "traffic"}}]}, "vehicles: highway-env needs at least one that is driven"),
    ],
)
def test_mistakes_are_one_line(overrides: dict[str, Any], why: str) -> None:
    with pytest.raises(CoopenvError, match=why):
        coopenv.parallel_env(CROSSING, overrides=overrides)


def test_missing_vehicles_are_named_at_the_reset() -> None:
    two = [{"motion": {"kind": "driven"}}] * 2
    crowd = [{"motion": {"kind": "driven"}}] + [{"motion": {"kind": "traffic"}}] * 9
    for name, overrides, why in (
        (ROUNDABOUT, {"vehicles": two}, "vehicles: 2 are driven, but highway-env drives 1 there"),
        (ROUNDABOUT, {"vehicles": crowd}, "vehicles: 9 are in traffic, but highway-env has fewer there"),
    ):
        env = coopenv.parallel_env(name, overrides=overrides)
        with pytest.raises(CoopenvError, match=why):
            env.reset(seed=5)


def test_surplus_traffic_leaves_at_the_start_and_is_an_error_later() -> None:
    engine = engine_of(CROSSING, **{"highway.most_vehicles": 0, "highway.config.spawn_probability": 1.0})
    engine.reset([5])
    assert len(road_of(engine).vehicles) == 6
    with pytest.raises(CoopenvError, match=r"highway\.most_vehicles: 0 are too few"):
        for _ in range(50):
            engine.step()


def test_other_environments_need_what_highway_env_has() -> None:
    for overrides, why in (  # of an environment without defaults of vehicles
        ({"vehicles.0.motion": {"kind": "traffic"}}, r"vehicles\.0\.routes: needed by traffic"),
        ({"backend": "highway"}, "highway: needed"),
        ({"vehicles": [{}]}, r"vehicles\.0\.initial_pose: needed"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.load_scenario("busy_intersection", overrides)
    with pytest.raises(CoopenvError, match="backend 'simulated': highway_roundabout has backend = \"highway\""):
        coopenv.parallel_env(ROUNDABOUT, backend="simulated")


def test_states_of_others_are_refused() -> None:
    env, other = coopenv.parallel_env(CROSSING), coopenv.parallel_env(CROSSING)
    env.reset(seed=1)
    other.reset(seed=2)
    state = other.get_state()
    before = env.engine.view("position").copy()
    for wrong in (None, [], [1]):
        with pytest.raises(CoopenvError, match="programs: expected 1 of backend 'highway'"):
            env.set_state({**state, "programs": wrong})
        assert np.array_equal(env.engine.view("position"), before)
    env.set_state(state)
    assert np.array_equal(env.engine.view("position"), other.engine.view("position"))


def test_roads_are_drawn() -> None:
    env = coopenv.parallel_env(ROUNDABOUT, render_mode="rgb_array")
    roads = env.scenario.roads
    assert len(roads) > 50 and not any(road.marked for road in roads)
    on_the_ring = [road for road in roads if abs(np.hypot(*road.start) - 20.0) < 0.01]
    assert len(on_the_ring) > 40
    env.reset(seed=1)
    picture = env.render()
    assert picture is not None
    asphalt = (picture == np.array([0xE2, 0xE2, 0xE2])).all(axis=-1)
    assert asphalt.mean() > 0.01


@pytest.mark.parametrize(("name", "speed", "seed"), [(CROSSING, 10.0, 4), (ROUNDABOUT, 6.0, 1)])
def test_the_route_can_be_driven_by_observations(name: str, speed: float, seed: int) -> None:
    env = coopenv.parallel_env(name, observation="dict", overrides={"horizon": 20.0, "termination.collision": False})
    ahead = 2.0 * env.scenario.observation.route_step
    top, widest = env.scenario.dynamics.max_speed, env.scenario.action.steering
    assert widest is not None
    place = next(i for i, vehicle in enumerate(env.scenario.vehicles) if vehicle.motion.kind == "driven")
    driver = f"vehicle_{place + 1}"
    observations, infos = env.reset(seed=seed)
    offset = []
    while driver in env.agents:
        seen = observations[driver]
        beta = np.arcsin(np.clip(2.5 * 2.0 * np.sin(seen["route_ahead"][..., 1].item()) / ahead, -0.9, 0.9))
        actions = {agent: np.array([-1.0, 0.0]) for agent in env.agents}
        actions[driver] = np.array([2.0 * speed / top - 1.0, np.arctan(2.0 * np.tan(beta)) / widest])
        observations, *_, infos = env.step(actions)
        offset.append(abs(float(observations[driver]["route_offset"].item())))
    assert infos[driver]["outcome"] == "arrived"
    assert max(offset[5:]) < 1.0
    engine, agent = env.engine, env.engine.world.model.landmarks + place
    driven = engine.world.programs[0].environment.vehicle
    engine.step(ticks=2)
    assert engine.view("present")[0, agent] == 0  # who has arrived leaves
    assert not any(car is driven for car in road_of(engine).vehicles)
