"""The key `sensing`; vehicles with a camera, noise or limits of their own; a camera that pans."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.api.engine import Engine
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import ActionError, ScenarioError
from coopenv.estimation import Sight
from coopenv.observers.setups import observer_init_of
from coopenv.policies.base import decide, random_policy, zero_policy
from coopenv.runs import record
from coopenv.scenario import Scenario, load_scenario, parse_scenario
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.worlds import Replay
from tests.helpers.builders import command, constant, run, same_bits, scenario, simulate, start, vehicle
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES
from tests.oracles.geometry import OPTICAL_TO_BODY_FORWARD as FORWARD

WORLDS, DECISIONS = 6, 60
OF_TRUTH_AND_RADIO = (
    *("rotation", "position", "velocity", "speed", "turn", "ended", "collided", "odometry_scale", "gyro_bias"),
    *("increment_rotation", "increment_translation", "odometry_velocity", "inbox_tick", "outbox_tick"),
)
ERRORS = {"noise.odometry_scale": 0.03, "noise.gyro_bias": 0.01}


@cache
def driven(sensing: str, dtype: str = "float64") -> list[dict[str, np.ndarray]]:
    """Return the state after each decision under the same actions; the camera misses, and is bounded by its image."""
    scenario = coopenv.load_scenario(FOUR_WAY, {"sensing": sensing, "camera.miss_probability": 0.3, **ERRORS})
    world = simulate(scenario, WORLDS, dtype)
    world.reset(range(WORLDS))
    generator = np.random.default_rng(2)
    states = [world.get_state()]
    for _ in range(DECISIONS):
        world.actions.assign(generator.uniform(-0.5, 1.0, (WORLDS, 4, 2)).astype(world.precision.numpy))
        world.advance(scenario.ticks_per_decision)
        states.append(world.get_state())
    return states


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sensing", ["ideal", "blind"])
def test_truth_odometry_and_radio_stay_bit_for_bit(sensing: str, dtype: str) -> None:
    for sensed, other in zip(driven("sensed", dtype), driven(sensing, dtype), strict=True):
        for name in OF_TRUTH_AND_RADIO:
            assert same_bits(sensed[name], other[name]), name
    last = driven("sensed", dtype)[-1]
    assert (last["ended"] != 0).any() and (last["inbox_tick"] > 0).any()
    assert not same_bits(last["estimate_position"], driven(sensing, dtype)[-1]["estimate_position"])


def test_ideal_measures_every_neighbour_and_blind_none() -> None:
    neighbours = np.array([[n < 12 + i for n in range(16)] for i in range(4)])
    seen = {s: np.array([state["sight"] == Sight.VISIBLE for state in driven(s)]) for s in ("sensed", "ideal", "blind")}
    assert (seen["ideal"] == neighbours).all()
    assert not seen["blind"].any()
    assert 0.02 < seen["sensed"].mean() / seen["ideal"].mean() < 0.5
    assert (driven("blind")[-1]["bearing_tick"] == -1).all()


def test_bearings_that_both_sense_have_the_same_noise() -> None:
    """Bearings that both measure are equal, noise and all; the others have noise of the same size."""
    misfit = []
    for sensed, ideal in zip(driven("sensed"), driven("ideal"), strict=True):
        both = sensed["sight"] == Sight.VISIBLE
        assert_allclose(ideal["bearing"][both], sensed["bearing"][both], atol=1e-12)
        misfit.append(_deviations(ideal)[(ideal["sight"] == Sight.VISIBLE) & ~both])
    angle = np.concatenate(misfit)
    assert np.sqrt(np.mean(angle**2) / 2) == pytest.approx(0.003, rel=4 / np.sqrt(2 * len(angle)))


def _deviations(state: dict[str, np.ndarray]) -> np.ndarray:
    """Return the angles (W, N, A) between measured and true bearings, rad."""
    scenario = coopenv.load_scenario(FOUR_WAY)
    markers = np.array([agent.marker for agent in (*scenario.landmarks, *scenario.vehicles)])
    R, position = state["rotation"], state["position"]
    point = position + np.einsum("waij,aj->wai", R, markers)
    eye = position[:, 12:] + R[:, 12:] @ np.array(scenario.camera.position)
    line = point[:, None] - eye[:, :, None]
    ray = np.einsum("wnji,wnaj->wnai", R[:, 12:] @ FORWARD, line)
    ray /= np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    return np.arcsin(np.minimum(np.linalg.norm(np.cross(ray, state["bearing"]), axis=-1), 1.0))


SENSED = {"mode": "sensed", "acyclic": True}
ASIDE = (2.0, -1.0, 0.5)
NEAR, NEARER = (0.0, 0.002, 0.5), (0.0, -0.002, 0.5)


def test_missing_tables_of_a_vehicle_are_the_scenario_s() -> None:
    own = {"noise": {"bearing": {"scale": 0.1}, "slip": {"rate": 1.0}}, "camera": {"range": 3.0}}
    made = scenario(
        [vehicle(), vehicle(ASIDE, **own, dynamics={"max_speed": 2.0})],
        noise={"velocity": 0.2, "bearing": {"model": "paper", "scale": 0.3}},
        camera={"miss_probability": 0.1},
        dynamics={"wheelbase": 0.5},
    )
    noise, camera, limits = made.noises[1], made.cameras[1], made.limits[1]
    assert (noise.velocity, noise.bearing.model, noise.bearing.scale, noise.slip.rate) == (0.2, "paper", 0.1, 1.0)
    assert (camera.range, camera.miss_probability) == (3.0, 0.1)
    assert (limits.max_speed, limits.wheelbase) == (2.0, 0.5)
    assert (made.noises[0], made.cameras[0], made.limits[0]) == (made.noise, made.camera, made.dynamics)
    again = parse_scenario(made.model_dump(mode="json"), "dumped")
    assert again == made and again.noises == made.noises


def test_tables_equal_to_the_scenarios_change_nothing() -> None:
    """Half of the vehicles have everything written out once more."""
    plain = load_scenario(FOUR_WAY)
    parts = {part: getattr(plain, part).model_dump() for part in ("camera", "noise", "dynamics")}
    written = {f"vehicles.{i}.{part}": table for i in (1, 3) for part, table in parts.items()}
    worlds = [simulate(load_scenario(FOUR_WAY, given), 2) for given in ({}, written)]
    assert worlds[0].scenario != worlds[1].scenario
    for world in worlds:
        world.reset([1, 2])
        world.actions.assign(np.full((2, 4, 2), 0.3))
        world.advance(120)
    a, b = (world.get_state() for world in worlds)
    for name in a:
        assert same_bits(a[name], b[name]), name


def test_cameras_of_their_own_see_differently() -> None:
    """Three vehicles in nearly one place: one sees as far as it goes, the others 2 m, the second to its left."""
    places = {"A": [5.0, 0.1, 0.5], "B": [1.5, 0.0, 0.5], "C": [0.0, 1.0, 0.5]}
    landmarks = [{"name": name, "position": place} for name, place in places.items()]
    turned = Rotation.from_euler("z", 90.0, degrees=True) * Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
    pinhole = {"model": "pinhole", "orientation": "forward"}
    forward_turned = {"range": 2.0, "orientation": turned.as_quat(scalar_first=True).tolist()}
    made = scenario(
        [vehicle(), vehicle(NEAR, camera=forward_turned), vehicle(NEARER, camera={"range": 2.0})],
        landmarks=landmarks,
        camera=pinhole,
        topology=SENSED,
    )
    state = start(made).get_state()
    seen = state["sight"][0, :, :3] == Sight.VISIBLE
    assert seen.tolist() == [[True, True, False], [False, False, True], [False, True, False]]
    assert_allclose(state["bearing"][0, 1, 2], [0.0, 0.0, 1.0], atol=1e-2)  # in the middle of its image


def test_observers_know_their_own_camera_and_noise() -> None:
    own = {"camera": {"position": [0.5, 0.0, 0.3]}, "noise": {"velocity": 0.4, "gyro_bias": [0.0, 0.0, 0.02]}}
    made = scenario([vehicle(), vehicle(ASIDE, **own)], noise={"velocity": 0.1})
    first, second = observer_init_of(made, simulate(made, 1).model).setups
    assert (first.noise.velocity, second.noise.velocity) == (0.1, 0.4)
    assert second.noise.gyro_bias == (0.0, 0.0, 0.02) and first.noise.gyro_bias == (0.0, 0.0, 0.0)
    assert first.lever_arm.tolist() == [0.0, 0.0, 0.0] and second.lever_arm.tolist() == [0.5, 0.0, 0.3]


@pytest.mark.parametrize("observer", ["riccati", "robust", "mekf"])
def test_observers_converge_with_two_cameras(observer: str) -> None:
    """Noise-free, from a wrong start; one camera sits elsewhere and looks backwards."""
    backwards = {"orientation": [0.0, 0.0, 0.0, 1.0], "position": [-0.4, 0.2, 0.3]}
    believed = {"position_radius": 0.05, "orientation_angle": 0.05}
    turning = constant([0.3, 0.0, 0.0], [0.0, 0.0, 0.3])
    vehicles = [
        vehicle(place, motion=turning, initial_estimate=believed, **more)
        for place, more in (((0, 0, 0.5), {}), (ASIDE, {"camera": backwards}))
    ]
    made = scenario(vehicles, horizon=20.0, observer={"name": observer}, camera={"orientation": "forward"})
    position = _final_error(made)
    assert (position < 5e-3).all(), position


def _final_error(made: Scenario) -> np.ndarray:
    env = CooperativeLocalisationEnv(made, "test", dtype="float64")
    env.reset(seed=1)
    while env.agents:
        *_, infos = env.step({agent: np.zeros(2) for agent in env.agents})
    return np.array([info["position_error"] for info in infos.values()])


def test_limits_of_their_own() -> None:
    fast = {"max_speed": 4.0, "max_acceleration": 50.0, "speed_time_constant": 0.0, "latency": 0.1}
    driven = {"kind": "driven"}
    made = scenario([vehicle(motion=driven), vehicle((5, 0, 0.5), motion=driven, dynamics=fast)])
    world = start(made)
    command(world, [[1.0, 0.0], [0.0, 0.0]])
    states = run(world, 60)
    assert states[-1]["speed"][0].tolist() == pytest.approx([1.53, 2.0], abs=0.05)
    assert (np.array([s["speed"][0, 1] for s in states[:7]]) == 0.0).all()  # dead time
    first, second = observation_layout(made).actions
    assert (first[0].high, second[0].high, second[0].level(2.0)) == (1.53, 4.0, 0.0)


def test_impossible_sensors_are_named() -> None:
    def message(**own: Any) -> str:
        with pytest.raises(ScenarioError) as error:
            scenario([vehicle(), vehicle(ASIDE, **own)], action={"steering": 0.5})
        return str(error.value)

    assert "vehicles.1.dynamics.latency: 1 s is longer" in message(dynamics={"latency": 1.0})
    assert "above vehicles.1.dynamics.max_steering (0.3 rad)" in message(dynamics={"max_steering": 0.3})
    assert "vehicles.1.camera" in message(camera={"reach": 3.0})
    driven = {"kind": "driven", "initial_speed": 1.0}
    assert "vehicles.1.motion.initial_speed" in message(dynamics={"max_speed": 0.5}, motion=driven)


def test_a_recording_keeps_them() -> None:
    own = {"camera": {"position": [0.3, 0.1, 0.2], "orientation": "forward"}, "noise": {"bearing": {"scale": 0.02}}}
    made = scenario([vehicle(motion=constant([0.2, 0, 0])), vehicle((1, 1, 0.5), **own)], horizon=2.0)
    recording = record(made, 3)
    replayed = Replay(recording, "test").world(1, "float64", "cpu", 1)
    replayed.reset([0])
    replayed.advance(60)
    world = start(made, 3)
    world.advance(60)
    L = world.model.landmarks
    assert_allclose(replayed.get_state()["bearing"], world.get_state()["bearing"], atol=1e-12)
    assert_allclose(replayed.get_state()["estimate_position"], world.get_state()["estimate_position"], atol=1e-9)
    assert replayed.get_state()["position"].shape[1] == L + 2


PAN = {"limit": 1.2, "rate": 0.9}
DRIVEN = {"kind": "driven"}
CROSSING: dict[str, Any] = {
    "action.pan": PAN,
    "observation.include": ["estimate", "quality", "bearings", "odometry", "messages", "goal", "pan"],
}


def pans(world: Any, levels: Any) -> None:
    """Stand still and ask for pan angles, levels (N,)."""
    actions = np.zeros((world.worlds, world.model.vehicles, 3))
    actions[..., 0], actions[..., 2] = -1.0, levels
    world.actions.assign(actions.astype(world.precision.numpy))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_camera_pans_at_its_rate_up_to_its_limit(dtype: str) -> None:
    made = scenario([vehicle(motion=DRIVEN), vehicle((2, -1, 0.5), motion=DRIVEN)], action={"pan": PAN})
    world = start(made, 0, dtype)
    pans(world, [0.5, -2.0])
    angles = np.array([state["pan"][0] for state in run(world, 120)], float)
    time = np.arange(121) / 60
    assert_allclose(angles[:, 0], np.minimum(0.9 * time, 0.6), atol=1e-5)
    assert_allclose(angles[:, 1], -np.minimum(0.9 * time, 1.2), atol=1e-5)


def test_the_last_action_and_its_price_hold_the_angle_that_was_asked_for() -> None:
    """Two entries without a pan, three with one; `control` is minus the square of them all."""
    actions = np.array([[0.3, -0.4, 0.5]] * 4)
    for given, size in (({}, 2), ({"action.pan": PAN}, 3)):
        made = load_scenario("urban_crossing", {**given, "observation.include": ["self"]})
        engine = Engine(made, 1)
        engine.reset([0])
        engine.step(actions[None, :, :size])
        observed = engine.layout["last_action"].values(engine.view("observation")[0])
        assert_allclose(observed, actions[:, :size], atol=1e-6)
        control = engine.view("terms")[0][:, engine.reward_terms.index("control")]
        assert_allclose(control, -np.sum(actions[:, :size] ** 2, axis=1), rtol=1e-5)


def test_dead_time_holds_for_it_too() -> None:
    made = scenario([vehicle(motion=DRIVEN)], action={"pan": PAN}, dynamics={"latency": 0.05})
    world = start(made)
    pans(world, 1.0)
    angles = np.array([state["pan"][0, 0] for state in run(world, 6)])
    assert_allclose(angles, 0.9 / 60 * np.array([0, 0, 0, 0, 1, 2, 3]), atol=1e-12)


def test_a_panned_camera_sees_as_a_camera_mounted_so() -> None:
    """Same sights, and the same bearings in the body frame, distortion, pixels and mounting error included."""
    camera = {
        "model": "pinhole",
        "position": [0.3, 0.1, 0.2],
        "distortion": [-0.35, 0.14, 0.002, 0.0006, 0.0],
        "quantise": True,
        "extrinsics_error": 0.05,
    }
    sensed = {"topology": {"mode": "sensed"}, "noise": {"bearing": {"scale": 0.01}}, "camera": camera}
    turned = Rotation.from_euler("z", 0.9).as_matrix() @ FORWARD
    quaternion = Rotation.from_matrix(turned).as_quat(scalar_first=True).tolist()
    marks = [
        {"name": f"L{i}", "position": [3.0 * np.cos(a), 3.0 * np.sin(a), 0.6]}
        for i, a in enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False))
    ]
    panned = start(scenario([vehicle(motion=DRIVEN)], landmarks=marks, action={"pan": PAN}, **sensed), 5)
    fixed = scenario([vehicle(motion=DRIVEN, camera={"orientation": quaternion})], landmarks=marks, **sensed)
    mounted = start(fixed, 5)
    pans(panned, 0.75)
    mounted.actions.assign(np.array([[[-1.0, 0.0]]], dtype=mounted.precision.numpy))
    for world in (panned, mounted):
        world.advance(60)
    a, b = panned.get_state(), mounted.get_state()
    assert_array_equal(a["sight"], b["sight"])
    seen = a["sight"][0, 0] == Sight.VISIBLE
    assert 3 <= seen.sum() <= 6 and not seen[0] and seen[3]  # 73 deg, ahead is out of view
    assert_allclose(a["bearing"][0, 0, seen] @ FORWARD.T, b["bearing"][0, 0, seen] @ turned.T, atol=1e-9)


def test_without_it_nothing_changes() -> None:
    """With a pan of zero, truth, bearings and estimates are what they are without the third entry."""
    plain, able = (simulate(load_scenario(FOUR_WAY, given), 2) for given in ({}, {"action.pan": PAN}))
    for world, size in ((plain, 2), (able, 3)):
        world.reset([3, 4])
        actions = np.random.default_rng(0).uniform(-1, 1, (2, 4, 2))
        world.actions.assign(np.concatenate([actions, np.zeros((2, 4, size - 2))], axis=-1))
        world.advance(120)
    a, b = plain.get_state(), able.get_state()
    for name in a:
        if name not in ("action", "actions"):
            assert same_bits(a[name], b[name]), name


@pytest.mark.parametrize("observer", ["robust", "mekf_covariance"])
def test_estimates_stay_consistent_while_it_pans(observer: str) -> None:
    """Embedded and plug-in observers receive bearings in the body frame: ANEES over six stays about one."""
    worlds = 24 if observer == "robust" else 2
    starts = {"vehicles.*.initial_estimate": {"position_radius": 0.05, "orientation_angle": 0.02}}
    given = {**CROSSING, **starts, "action.longitudinal": "speed", "horizon": 8.0}
    env = coopenv.make_vec(FOUR_WAY, num_worlds=worlds, observer=observer, dtype="float64", overrides=given)
    env.reset(seed=11)
    generator, nees = np.random.default_rng(1), []
    for step in range(70):
        if step % 10 == 0:
            actions = generator.uniform(-1, 1, (4 * worlds, 3))
            actions[:, 0], actions[:, 1] = -0.7, actions[:, 1] * 0.2
        env.step(actions)
        if step >= 20:
            nees.append(np.array(env.engine.view("nees")))
    assert np.abs(env.engine.view("pan")).max() > 0.9
    assert 0.5 < np.mean(nees) / 6 < 1.5, np.mean(nees) / 6
    env.close()


def test_an_action_has_three_entries_everywhere() -> None:
    env = coopenv.parallel_env(FOUR_WAY, overrides=CROSSING)
    observations, _ = env.reset(seed=0)
    assert env.action_space("vehicle_1").shape == (3,)
    layout = env.observation_layout
    assert [(f.name, f.low, f.high) for f in layout.action][2] == ("pan", -1.2, 1.2)
    for _ in range(10):
        observations, *_ = env.step({agent: np.array([-1.0, 0.0, 0.5]) for agent in env.agents})
    assert observations["vehicle_1"][layout["camera_pan"].slice] == pytest.approx([0.5], abs=1e-5)
    with pytest.raises(ActionError, match=r"shape \(2,\), expected \(3,\)"):
        env.step({agent: np.zeros(2) for agent in env.agents})
    vec = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides=CROSSING)
    vec.reset(seed=0)
    assert vec.action_space.shape == (8, 3)
    vec.step(vec.action_space.sample())
    with pytest.raises(ActionError, match=r"expected \(8, 3\)"):
        vec.step(np.zeros((8, 2)))
    rows = np.stack(list(observations.values()))
    for policy in (zero_policy(0, 3), random_policy(0, 3)):
        assert decide(policy, rows, 3).shape == (4, 3)


def test_a_recording_replays_to_the_same_observations(tmp_path: Path) -> None:
    made = load_scenario(FOUR_WAY, {**CROSSING, "horizon": 3.0})
    policy = lambda observations: np.tile([-0.5, 0.1, 0.8], (len(observations), 1))  # noqa: E731
    recording = record(made, 3, policy)
    assert recording.pan is not None and recording.pan.max() > 0.9
    write_recording(recording, tmp_path / "pan.mcap")
    read = read_recording(tmp_path / "pan.mcap")
    assert read.pan is not None
    assert_array_equal(read.pan, recording.pan)
    replay = Replay(read, "pan").world(1, "float64", "cpu", 1)
    replay.reset([0])
    simulated = simulate(made, 1)
    simulated.reset([3])
    for _ in range(20):
        simulated.actions.assign(np.tile([-0.5, 0.1, 0.8], (1, 4, 1)))
        simulated.advance(made.ticks_per_decision)
        replay.advance(made.ticks_per_decision)
    a, b = simulated.get_state(), replay.get_state()
    for name in ("pan", "estimate_position", "estimate_rotation"):
        assert_allclose(a[name], b[name], atol=1e-9, err_msg=name)
    seen = a["sight"] == Sight.VISIBLE
    assert seen.any()
    assert_allclose(a["bearing"][seen], b["bearing"][seen], atol=1e-9)


def test_impossible_pans_are_named() -> None:
    for given, word in (({"limit": 4.0, "rate": 1.0}, "action.pan.limit"), ({"limit": 1.0}, "action.pan.rate")):
        with pytest.raises(ScenarioError, match=word):
            scenario([vehicle(motion=DRIVEN)], action={"pan": given})
    assert len(observation_layout(scenario([vehicle(motion=DRIVEN)])).action) == 2
