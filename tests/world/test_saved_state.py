"""A state is restored as a whole or not at all, and holds nothing that a kernel could go wrong with."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv import CoopenvError
from coopenv.observers.registry import find_embedded
from coopenv.world.world import World

EYE, NAN = np.eye(3), np.nan


@pytest.fixture(scope="module", params=["float32", "float64"])
def env(request: pytest.FixtureRequest) -> Any:
    made = coopenv.parallel_env("busy_intersection", observer="robust", dtype=request.param)
    made.reset(seed=0)
    for _ in range(3):
        made.step({agent: np.zeros(2, np.float32) for agent in made.agents})
    return made


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(a[name].tobytes() == b[name].tobytes() for name in a if isinstance(a[name], np.ndarray))


@pytest.mark.parametrize(
    ("name", "index", "value", "why"),
    [
        (
            "observer_belief.members",
            (0, 1),
            2**31 - 1,
            r"members' at \(0, 1\): 2147483647 is not in 1 \.\. \d+",
        ),
        ("observer_belief.members", (0, 1), -(2**31), r"is not in 1 .. \d+"),
        ("observer_belief.members", (0, 1), 0, r"is not in 1 .. \d+"),
        ("observer_member.vehicle", (0, 1, 0), 2**31 - 1, "'observer_member.vehicle'"),
        ("observer_search.hypotheses", (0, 0), 10**6, "'observer_search.hypotheses'"),
        ("observer_search.attempts", (0, 0), -1, "'observer_search.attempts'"),
        ("observer_P", (0, 0, 0, 0, 1, 1), -5.0, "'observer_P' at .* is not a covariance"),
        ("observer_member.pose.R", (0, 0, 0), 0.0, "'observer_member.pose.R' at .* is not a rotation"),
        ("odometry_samples", (0, 2), -(2**31), "'odometry_samples' at .* is not as many as at this tick"),
        ("odometry_samples", (0, 2), 2**31 - 1, "'odometry_samples'"),
        ("odometry_samples", (0, 2), 0, "'odometry_samples'"),
        ("ended", (0, 0), 2**31 - 1, "'ended' at .*: 2147483647 is not in -1 .. last_outcome"),
        ("tick", (0,), -1, "'tick' at .* is not in 0 .. horizon_ticks"),
        ("tick", (0,), 2**31 - 1, "'tick'"),
        ("bearing_tick", (0, 0, 0), 19, "'bearing_tick' at .*: 19 is not in -1 .. tick"),
        ("outbox_tick", (0, 0, 0), -2, "'outbox_tick'"),
        ("inbox_tick", (0, 0, 0), 10**6, "'inbox_tick'"),
        ("corrected_tick", (0, 0), 19, "'corrected_tick'"),
        ("sight", (0, 0, 0), 6, "'sight'"),
        ("rotation", (0, 0), 2 * EYE, "'rotation' at .* is not a rotation"),
        ("rotation", (0, 0, 0, 0), NAN, "'rotation' at .* is not a rotation"),
        ("estimate_rotation", (0, 0), -EYE, "'estimate_rotation' at .* is not a rotation"),
        ("estimate_position", (0, 0, 1), np.inf, "'estimate_position' at .* is not finite"),
        ("position", (0, 0, 1), 1.1e9, "'position' at .* is not finite and at most 1e[+]09"),
        ("covariance", (0, 0), -np.eye(6), "'covariance' at .* is not a covariance"),
        ("covariance", (0, 0, 0, 5), 1e6, "'covariance' at .* is not a covariance"),
        ("bearing", (0, 0, 1), 2.0, "'bearing' at .* is not a unit vector"),
        ("gramian_11", (0, 0, 0, 0, 0), NAN, "'gramian_11'"),
        ("steering", (0, 0), 1.7, "'steering'"),
        ("last_tick", (0, 0), 10**6, "'last_tick'"),
        ("over", (0,), 2, "'over'"),
    ],
)
def test_one_number_that_is_none(env: Any, name: str, index: tuple[int, ...], value: Any, why: str) -> None:
    before = env.get_state()
    state = env.get_state()
    state[name][index] = value
    with pytest.raises(CoopenvError, match=f"this state does not fit busy_intersection_v0: state: field .*{why}"):
        env.set_state(state)
    assert same(before, env.get_state())


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda s: s.pop("tick"), "field 'tick' is missing"),
        (lambda s: s.update(tick=np.zeros(2, int)), r"field 'tick' has shape \(2,\), expected \(1,\)"),
        (lambda s: s.update(tick=s["tick"].astype(object)), "field 'tick' of object does not fit into int32"),
        (lambda s: s.update(tick=np.array([0.5])), "field 'tick' of float64 does not fit into int32"),
        (lambda s: s.update(tick=np.array([2**40])), "field 'tick' of int64 does not fit into int32"),
        (lambda s: s.update(speed=[["a"] * 5]), "field 'speed' of <U1 does not fit into float"),
        (lambda s: s.update(speed=[[1.0], [2.0, 3.0]]), "field 'speed': "),
        (lambda s: s.update(position=s["position"] * 1j), "field 'position' of complex"),
        (lambda s: s.update(agents=[["x"]]), r"its agents are \[\['x'\]\]"),
        (lambda s: s.update(agents=["vehicle_1"] * 9), "its agents are"),
        (lambda s: s.update(agents=["vehicle_2", "vehicle_1"]), "its agents are"),
        (lambda s: s.update(agents=None), "its agents are None"),
        (lambda s: s.update(scenario=None), "it is of another scenario"),
    ],
)
def test_what_is_no_state(env: Any, change: Any, why: str) -> None:
    before, state = env.get_state(), env.get_state()
    change(state)
    with pytest.raises(CoopenvError, match=why):
        env.set_state(state)
    assert same(before, env.get_state())


def test_precisions_may_differ(env: Any) -> None:
    other = coopenv.parallel_env("busy_intersection", observer="robust", dtype="float64")
    other.set_state(env.get_state())
    assert np.allclose(other.state(), env.state())
    env.set_state(other.get_state())


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


@pytest.mark.parametrize("observer", ["robust", "robust_joint"])
def test_every_field_has_a_rule(observer: str) -> None:
    """Whole numbers may be indices or counts, so that none goes without; other numbers have to be finite anyway."""
    world = World(coopenv.load_scenario("busy_intersection"), observer=find_embedded(observer))
    rules = world.state_rules()
    whole = {name for name, array in world.state_arrays().items() if array.numpy().dtype.kind in "iu"}
    bits = ("belief", "member.report", "outbox", "inbox") + (("contact",) if observer == "robust_joint" else ())
    free = {f"observer_{name}.depends_on" for name in bits}
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
