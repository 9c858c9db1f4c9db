"""A state is restored as a whole or not at all, and holds nothing that a kernel could go wrong with."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv import CoopenvError
from coopenv.observers.registry import find_embedded
from coopenv.world.world import World

EYE, NAN = np.eye(3), np.nan


@pytest.fixture(scope="module")
def env() -> Any:
    made = coopenv.parallel_env("busy_intersection", observer="robust")
    made.reset(seed=0)
    for _ in range(3):
        made.step({agent: np.zeros(2, np.float32) for agent in made.agents})
    return made


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(a[name].tobytes() == b[name].tobytes() for name in a if isinstance(a[name], np.ndarray))


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("observer_belief.members", (0, 1), 2**31 - 1),
        ("observer_belief.members", (0, 1), -(2**31)),
        ("observer_belief.members", (0, 1), 0),
        ("observer_member.vehicle", (0, 1, 0), 2**31 - 1),
        ("observer_search.hypotheses", (0, 0), 10**6),
        ("observer_search.attempts", (0, 0), -1),
        ("observer_P", (0, 0, 0, 0, 1, 1), -5.0),
        ("observer_member.pose.R", (0, 0, 0), 0.0),
        ("odometry_samples", (0, 2), -(2**31)),
        ("odometry_samples", (0, 2), 2**31 - 1),
        ("odometry_samples", (0, 2), 0),
        ("ended", (0, 0), 2**31 - 1),
        ("tick", (0,), -1),
        ("tick", (0,), 2**31 - 1),
        ("bearing_tick", (0, 0, 0), 19),
        ("outbox_tick", (0, 0, 0), -2),
        ("inbox_tick", (0, 0, 0), 10**6),
        ("corrected_tick", (0, 0), 19),
        ("sight", (0, 0, 0), 6),
        ("rotation", (0, 0), 2 * EYE),
        ("rotation", (0, 0, 0, 0), NAN),
        ("estimate_rotation", (0, 0), -EYE),
        ("estimate_position", (0, 0, 1), np.inf),
        ("position", (0, 0, 1), 1.1e9),
        ("covariance", (0, 0), -np.eye(6)),
        ("covariance", (0, 0, 0, 5), 1e6),
        ("bearing", (0, 0, 1), 2.0),
        ("gramian_11", (0, 0, 0, 0, 0), NAN),
        ("steering", (0, 0), 1.7),
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
def test_one_number_that_is_none(env: Any, name: str, index: tuple[int, ...], value: Any) -> None:
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
        (lambda s: s.update(tick=np.array([0.5])), "'tick'"),
        (lambda s: s.update(tick=np.array([2**40])), "'tick'"),
        (lambda s: s.update(speed=[["a"] * 5]), "'speed'"),
        (lambda s: s.update(speed=[[1.0], [2.0, 3.0]]), "'speed'"),
        (lambda s: s.update(position=s["position"] * 1j), "'position'"),
        (lambda s: s.update(agents=[["x"]]), "agents"),
        (lambda s: s.update(agents=["vehicle_1"] * 9), "agents"),
        (lambda s: s.update(agents=["vehicle_2", "vehicle_1"]), "agents"),
        (lambda s: s.update(agents=None), "agents"),
        (lambda s: s.update(scenario=None), "scenario"),
    ],
)
def test_what_is_no_state(env: Any, change: Any, field: str) -> None:
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
    free = {f"observer_{name}.depends_on" for name in ("belief", "member.report", "outbox", "inbox")}
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
