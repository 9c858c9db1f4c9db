"""The key `sensing`, and vehicles with a camera, noise or limits of their own."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.api.terms.layout import observation_layout
from coopenv.backends.replay import Replay
from coopenv.base.errors import ScenarioError
from coopenv.estimation.outcomes import Sight
from coopenv.observers.runner import observer_init_of
from coopenv.runs import record
from coopenv.scenario import Scenario, load_scenario, parse_scenario
from tests.helpers.builders import command, constant, run, same_bits, scenario, simulate, start, vehicle
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES

WORLDS, DECISIONS = 6, 60
OF_TRUTH_AND_RADIO = (
    *("rotation", "position", "velocity", "speed", "steering", "ended", "collided", "odometry_scale", "gyro_bias"),
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


def test_what_is_sensed_anyway_has_the_same_noise() -> None:
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
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    scenario = coopenv.load_scenario(FOUR_WAY)
    markers = np.array([agent.marker for agent in (*scenario.landmarks, *scenario.vehicles)])
    R, position = state["rotation"], state["position"]
    point = position + np.einsum("waij,aj->wai", R, markers)
    eye = position[:, 12:] + R[:, 12:] @ np.array(scenario.camera.position)
    line = point[:, None] - eye[:, :, None]
    ray = np.einsum("wnji,wnaj->wnai", R[:, 12:] @ forward, line)
    ray /= np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    return np.arcsin(np.minimum(np.linalg.norm(np.cross(ray, state["bearing"]), axis=-1), 1.0))


SENSED = {"mode": "sensed", "acyclic": True}
ASIDE = (2.0, -1.0, 0.5)
NEAR, NEARER = (0.0, 0.002, 0.5), (0.0, -0.002, 0.5)


def test_what_a_vehicle_does_not_give_is_the_scenarios() -> None:
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


def test_what_is_impossible_is_named() -> None:
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
