"""States at a reset, and states that are saved: restored as a whole or not at all."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.spatial.transform import Rotation

import coopenv
from coopenv import CoopenvError
from coopenv.observers.registry import find_embedded
from coopenv.world.world import World
from tests.fuzz.states import same
from tests.helpers.builders import errors, estimated_position, quaternion_wxyz, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES

WORLDS = 4000


def drawn(estimate: dict[str, Any] | None = None, dtype: str = "float64", **pose: Any) -> dict[str, np.ndarray]:
    made = scenario(
        [{"initial_pose": {"position": [1.0, 2.0, 3.0], "yaw": 0.5, **pose}, "initial_estimate": estimate or {}}]
    )
    return {k: v.astype(float) for k, v in start(made, range(WORLDS), dtype).get_state().items()}


def turns(state: dict[str, np.ndarray]) -> Rotation:
    """Return R(0)^T Rhat(0)."""
    return Rotation.from_matrix(np.swapaxes(state["rotation"][:, -1], 1, 2) @ state["estimate_rotation"][:, 0])


@pytest.mark.parametrize("dtype", DTYPES)
def test_position_is_uniform_in_a_ball(dtype: str) -> None:
    state = drawn({"position_radius": 2.0}, dtype)
    offset = estimated_position(state)[:, 0] - state["position"][:, -1]
    radius = np.linalg.norm(offset, axis=1)
    assert radius.max() <= 2.0 + 1e-5
    assert stats.kstest((radius / 2.0) ** 3, "uniform").pvalue > 1e-3
    direction = offset / radius[:, None]
    for axis in np.vstack([np.eye(3), [0.6, 0.0, 0.8]]):
        assert stats.kstest((direction @ axis + 1) / 2, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(radius, direction[:, 2])[0, 1]) < 0.07


def test_orientation_angle_is_uniform_in_its_range() -> None:
    w = turns(drawn({"orientation_angle": 0.8})).as_rotvec()
    angle = np.linalg.norm(w, axis=1)
    assert angle.max() <= 0.8 + 1e-6
    assert stats.kstest(angle / 0.8, "uniform").pvalue > 1e-3
    for axis in np.eye(3):
        assert stats.kstest((w @ axis / angle + 1) / 2, "uniform").pvalue > 1e-3


def test_uniform_orientation_is_haar() -> None:
    """The angle of a Haar rotation has the distribution (a - sin a) / pi; its axis is uniform; so are its columns."""
    turn = turns(drawn({"orientation_angle": "uniform"}))
    angle = turn.magnitude()
    assert stats.kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3
    assert angle.max() > 3.0
    columns = turn.as_matrix()
    for i in range(3):
        for j in range(3):
            assert stats.kstest((columns[:, i, j] + 1) / 2, "uniform").pvalue > 1e-4


def test_yaw_and_position_spreads_are_in_the_starts_own_axes() -> None:
    state = drawn(position_spread=[2.0, 0.5, 0.1], yaw_spread=0.3)
    R0 = Rotation.from_euler("z", 0.5).as_matrix()
    local = (state["position"][:, -1] - [1, 2, 3]) @ R0
    for column, half in zip(local.T, (2.0, 0.5, 0.1), strict=True):
        assert np.abs(column).max() <= half
        assert stats.kstest((column / half + 1) / 2, "uniform").pvalue > 1e-3
    turn = Rotation.from_matrix(R0.T @ state["rotation"][:, -1]).as_rotvec()
    assert_allclose(turn[:, :2], 0.0, atol=1e-12)
    assert stats.kstest((turn[:, 2] / 0.3 + 1) / 2, "uniform").pvalue > 1e-3
    assert np.abs(np.corrcoef(np.column_stack([local, turn[:, 2]]).T) - np.eye(4)).max() < 0.07


def test_spread_starts_are_where_prescribed_motion_begins() -> None:
    made = scenario(
        [
            {
                "initial_pose": {"position": [0, 0, 0.5], "position_spread": [1, 1, 0], "yaw_spread": 1.0},
                "motion": {"kind": "constant", "linear": [0.5, 0, 0]},
            }
        ]
    )
    world = start(made, range(50))
    before = world.get_state()
    world.advance(60)
    moved = world.get_state()["position"][:, -1] - before["position"][:, -1]
    assert_allclose(moved, 0.5 * before["rotation"][:, -1, :, 0], atol=1e-12)


def test_independent_vehicles_worlds_and_streams() -> None:
    estimate = {"position_radius": 1.0, "orientation_angle": "uniform"}
    pose = {"position_spread": [1.0, 1.0, 0.0], "yaw_spread": 0.3}
    made = scenario(
        [{"initial_pose": {"position": [5.0 * i, 0, 0], **pose}, "initial_estimate": estimate} for i in range(2)]
    )
    state = start(made, range(WORLDS)).get_state()
    offset = (estimated_position(state) - state["position"][:, -2:]).reshape(WORLDS, 6)
    place = (state["position"][:, -2:, :2] - [[0, 0], [5, 0]]).reshape(WORLDS, 4)
    angle = np.array([np.trace(r) for r in state["estimate_rotation"].reshape(-1, 3, 3)]).reshape(WORLDS, 2)
    together = np.corrcoef(np.hstack([offset, place, angle]).T)
    assert np.abs(together - np.eye(12)).max() < 0.07
    ahead = np.corrcoef(offset[:-1, 0], offset[1:, 0])[0, 1]  # neighbouring seeds
    assert abs(ahead) < 0.07


TURN = [0.9, 0.1, -0.3, np.sqrt(1 - 0.81 - 0.01 - 0.09)]


def test_orientation_offset_multiplies_the_truth_from_the_right() -> None:
    state = drawn({"orientation_offset_wxyz": TURN})
    expected = Rotation.from_euler("z", 0.5) * Rotation.from_quat(TURN, scalar_first=True)
    assert_allclose(state["estimate_rotation"][0, 0], expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("absolute", "base"),
    [
        ({"yaw": -1.0}, Rotation.from_euler("z", -1.0)),
        ({"quaternion_wxyz": [0, 1, 0, 0]}, Rotation.from_rotvec([np.pi, 0, 0])),
    ],
)
def test_an_absolute_estimate_replaces_the_truth(absolute: dict[str, Any], base: Rotation) -> None:
    state = drawn({**absolute, "orientation_offset_wxyz": TURN}, yaw_spread=0.5)
    expected = base * Rotation.from_quat(TURN, scalar_first=True)
    assert_allclose(state["estimate_rotation"][:, 0], np.tile(expected.as_matrix(), (WORLDS, 1, 1)), atol=1e-12)


def test_absolute_position_and_its_offset() -> None:
    believed = drawn({"position": [7.0, 8.0, 9.0], "position_offset": [0.1, 0.2, 0.3]}, position_spread=[1, 1, 1])
    assert_allclose(estimated_position(believed)[:, 0], np.tile([7.1, 8.2, 9.3], (WORLDS, 1)), atol=1e-12)
    relative = drawn({"position_offset": [0.1, 0.2, 0.3]}, position_spread=[1, 1, 1])
    offset = estimated_position(relative)[:, 0] - relative["position"][:, -1]
    assert_allclose(offset, np.tile([0.1, 0.2, 0.3], (WORLDS, 1)), atol=1e-12)


def test_the_default_estimate_is_the_truth() -> None:
    made = scenario(
        [
            {
                "initial_pose": {
                    "position": [1, 2, 3],
                    "quaternion_wxyz": quaternion_wxyz(Rotation.from_rotvec([1, 2, 0.5]).as_matrix()),
                }
            }
        ]
    )
    world = start(made)
    position, angle = errors(world, world.get_state())
    assert position.max() < 1e-13
    assert angle.max() < 1e-6


def test_initial_covariance_and_counters() -> None:
    made = scenario([vehicle()], observer={"P0": [0.3, 4.0]})
    state = start(made).get_state()
    assert_allclose(state["covariance"][0, 0], np.diag([0.3] * 3 + [4.0] * 3))
    assert state["tick"][0] == state["episode"][0] == state["odometry_samples"][0, 0] == 0
    assert (state["bearing_tick"][0, 0, :4] == 0).all()  # the first frame is taken at t = 0
    assert_allclose(np.linalg.norm(state["bearing"][0, 0, :4], axis=1), 1.0)


EYE, NAN = np.eye(3), np.nan


@pytest.fixture(scope="module")
def env() -> Any:
    made = coopenv.parallel_env("busy_intersection", observer="robust")
    made.reset(seed=0)
    for _ in range(3):
        made.step({agent: np.zeros(2, np.float32) for agent in made.agents})
    return made


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("observer_belief.members", (0, 1), 2**31 - 1),
        ("observer_member.vehicle", (0, 1, 0), 2**31 - 1),
        ("observer_search.hypotheses", (0, 0), 10**6),
        ("observer_search.attempts", (0, 0), -1),
        ("observer_P", (0, 0, 0, 0, 1, 1), -5.0),
        ("observer_member.pose.R", (0, 0, 0), 0.0),
        ("odometry_samples", (0, 2), 2**31 - 1),
        ("ended", (0, 0), 2**31 - 1),
        ("tick", (0,), -1),
        ("bearing_tick", (0, 0, 0), 19),
        ("outbox_tick", (0, 0, 0), -2),
        ("inbox_tick", (0, 0, 0), 10**6),
        ("corrected_tick", (0, 0), 19),
        ("sight", (0, 0, 0), 6),
        ("rotation", (0, 0), 2 * EYE),
        ("estimate_rotation", (0, 0), -EYE),
        ("estimate_position", (0, 0, 1), np.inf),
        ("position", (0, 0, 1), 1.1e9),
        ("covariance", (0, 0), -np.eye(6)),
        ("bearing", (0, 0, 1), 2.0),
        ("gramian_11", (0, 0, 0, 0, 0), NAN),
        ("turn", (0, 0), 1.7),
        ("present", (0, 0), 2),
        ("parameter", (0, 0), np.inf),
        ("difficulty", (0,), 1.5),
        ("route_count", (0, 0), 1),
        ("route_drawn", (0, 0), 7),
        ("arrivals", (0, 0), -1),
        ("last_tick", (0, 0), 10**6),
        ("over", (0,), 2),
    ],
)
def test_one_invalid_number_is_refused(env: Any, name: str, index: tuple[int, ...], value: Any) -> None:
    before = env.get_state()
    state = env.get_state()
    state[name][index] = value
    with pytest.raises(CoopenvError, match=f"'{re.escape(name)}'"):
        env.set_state(state)
    assert same(before, env.get_state())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda s: s.pop("tick"), "'tick'"),
        (lambda s: s.update(tick=np.zeros(2, int)), "'tick'"),
        (lambda s: s.update(tick=s["tick"].astype(object)), "'tick'"),
        (lambda s: s.update(tick=np.array([2**40])), "'tick'"),
        (lambda s: s.update(speed=[[1.0], [2.0, 3.0]]), "'speed'"),
        (lambda s: s.update(position=s["position"] * 1j), "'position'"),
        (lambda s: s.update(agents=[["x"]]), "agents"),
        (lambda s: s.update(agents=["vehicle_2", "vehicle_1"]), "agents"),
        (lambda s: s.update(agents=None), "agents"),
        (lambda s: s.update(scenario=None), "scenario"),
    ],
)
def test_invalid_states_are_refused(env: Any, change: Any, field: str) -> None:
    before, state = env.get_state(), env.get_state()
    change(state)
    with pytest.raises(CoopenvError, match=field):
        env.set_state(state)
    assert same(before, env.get_state())


def test_precisions_may_differ() -> None:
    narrow, wide = (coopenv.parallel_env("busy_intersection", dtype=dtype) for dtype in ("float32", "float64"))
    narrow.reset(seed=0)
    wide.set_state(narrow.get_state())
    assert np.allclose(wide.state(), narrow.state())
    narrow.set_state(wide.get_state())


def test_before_the_first_reset() -> None:
    """Such a state is zero throughout, which is none to step from."""
    env = coopenv.parallel_env("busy_intersection")
    fresh = env.get_state()
    env.reset(seed=0)
    env.set_state(fresh)
    with pytest.raises(CoopenvError, match=r"step\(\) called before reset\(\)"):
        env.step({})
    batch = coopenv.make_vec("busy_intersection", num_worlds=2)
    batch.set_state(batch.get_state())
    with pytest.raises(CoopenvError, match=r"step\(\) called before reset\(\)"):
        batch.step(np.zeros((10, 2), np.float32))
    batch.reset(seed=0)
    batch.set_state(batch.get_state())
    batch.step(np.zeros((10, 2), np.float32))


def test_every_field_has_a_rule() -> None:
    """Whole numbers may be indices or counts, so that none goes without; other numbers have to be finite anyway."""
    world = World(coopenv.load_scenario("busy_intersection"), observer=find_embedded("robust"))
    rules = world.state_rules()
    whole = {name for name, array in world.state_arrays().items() if array.numpy().dtype.kind in "iu"}
    masks = ("belief.rejected_sources", *(f"{x}.depends_on" for x in ("belief", "member.report", "outbox", "inbox")))
    free = {f"observer_{name}" for name in masks}
    assert whole - rules.keys() == free
    assert rules.keys() <= world.state_arrays().keys()


# Plug-in observers


@pytest.mark.parametrize(
    ("observers", "why"),
    [
        (None, "no observers 'mekf' in it"),
        ([], "no observers 'mekf' in it"),
        ([5], "the observers do not fit"),
        ([{}], "the observers do not fit"),  # as before a reset
        ([{"observers": 1}], "the observers do not fit: KeyError: 'coordinates'"),
        ([{"observers": [], "coordinates": None, "mail": {}}], "not one observer per vehicle"),
    ],
)
def test_states_of_plug_ins(observers: Any, why: str) -> None:
    env = coopenv.parallel_env("busy_intersection_tracking", observer="mekf")
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(CoopenvError, match=why):
        env.set_state({**env.get_state(), "speed": 2.0 + before["speed"], "observers": observers})
    assert same(before, env.get_state())


@pytest.mark.parametrize("name", ["mekf", "covariance_intersection", "centralised"])
def test_damaged_observers_of_this_package_are_refused(name: str) -> None:
    env = coopenv.parallel_env("busy_intersection_tracking", observer=name)
    env.reset(seed=0)
    env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    before = env.get_state()
    env.set_state(before)
    assert same(before, env.get_state())
    state = env.get_state()
    setattr(state["observers"][0]["observers"][0], "poses" if name == "centralised" else "state", None)
    with pytest.raises(CoopenvError, match="state: the observers do not fit: "):
        env.set_state(state)
    assert same(before, env.get_state())


def test_messages_of_plug_ins() -> None:
    env = coopenv.parallel_env("busy_intersection_tracking", observer="mekf")
    env.reset(seed=0)
    env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    for change in (
        lambda mail: mail["sent"].append({}),
        lambda mail: mail["sent"][0].update({6: 5}),
        lambda mail: mail["sent"][0].update({"six": mail["sent"][0][6]}),
        lambda mail: mail["heard"][1].update({99: (6, mail["sent"][0][6])}),
        lambda mail: mail.update(bytes=np.full(5, np.nan)),
        lambda mail: mail.clear(),
    ):
        state = env.get_state()
        env.set_state(state)
        change(state["observers"][0]["mail"])
        with pytest.raises(CoopenvError, match="the observers do not fit"):
            env.set_state(state)
