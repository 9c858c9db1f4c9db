"""States that `get_state` never returned: fields of other values, shapes and types."""

from __future__ import annotations

import copy
import warnings
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import coopenv
from tests.fuzz import harness
from tests.helpers.four_way import FOUR_WAY

ENVIRONMENTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("busy_intersection", {"observer": "riccati", "dtype": "float32"}),
    ("busy_intersection", {"observer": "robust", "dtype": "float32"}),
    (FOUR_WAY, {"observer": "robust", "dtype": "float64"}),
    (FOUR_WAY, {"observer": "riccati", "dtype": "float32"}),
    ("crossing_path", {"observer": "riccati", "dtype": "float64"}),
    ("busy_intersection_tracking", {"observer": "mekf", "dtype": "float64"}),
    ("busy_intersection_tracking", {"observer": "centralised", "dtype": "float32"}),
)
STEPS = 6

NUMBERS = (0.0, 1.0, -1.0, 1e-300, 1e9, -1e9, 1.1e9, 1e38, 1e300, np.nan, np.inf, -np.inf)
WHOLE = (0, 1, 2, 3, 7, -1, -2, 17, 100, 2**31 - 1, -(2**31), 2**31, 2**62)
DTYPES = ("float16", "float32", "float64", "int8", "int64", "uint64", "bool", "complex128", "object", "U8", "M8[s]")


@cache
def world(kind: int) -> tuple[Any, list[Any]]:
    """Return an environment and states of it: before its first reset, at its start and later on."""
    name, options = ENVIRONMENTS[kind]
    env, rng = coopenv.parallel_env(name, **options), np.random.default_rng(0)
    states = [env.get_state()]
    env.reset(seed=kind)
    for k in range(31):
        if k in (0, 5, 30):
            states.append(env.get_state())
        env.step({agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents})
    return env, states


def prepare() -> None:
    """Build all environments."""
    for kind in range(len(ENVIRONMENTS)):
        world(kind)


def plausible(rng: np.random.Generator, old: np.ndarray) -> np.ndarray:
    """Return other values of a field's shape that may be what they should be."""
    shape, size = old.shape, old.size
    if shape[-2:] == (3, 3) and rng.random() < 0.8:
        return Rotation.random(size // 9, random_state=rng.integers(2**31)).as_matrix().reshape(shape)
    if shape[-2:] == (6, 6) and rng.random() < 0.8:
        L = rng.normal(size=shape) * 10.0 ** rng.integers(-4, 5)
        return L @ np.swapaxes(L, -1, -2)
    if old.dtype.kind in "iu":
        return rng.integers(-1, 4, size=shape)
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 9)
    if shape[-1:] == (3,) and rng.random() < 0.3:
        values /= np.linalg.norm(values, axis=-1, keepdims=True)
    return values


def hostile(rng: np.random.Generator, old: np.ndarray) -> Any:
    """Return something else in place of a field's values."""
    new = np.array(old, dtype=np.int64 if old.dtype.kind in "iu" else np.float64)
    pool = WHOLE if old.dtype.kind in "iu" else NUMBERS
    if rng.random() < 0.6:
        return plausible(rng, old)
    kind = rng.integers(6)
    if kind == 0 and new.size:
        new.ravel()[rng.integers(new.size)] = rng.choice(pool)
        return new
    if kind == 1:
        new[...] = rng.choice(pool)
        return new
    if kind == 2 and old.dtype.kind == "f":
        return new * rng.choice([0.5, 2.0, 1e3, 1e-6, -1.0])
    if kind == 3:
        return np.array(old).astype(rng.choice(DTYPES))
    if kind == 4:
        return [new.ravel(), new[None], new[:0], new[..., :-1], np.zeros(())][rng.integers(5)]
    return [None, "x", 5, object(), {}, [[1], [2, 3]], new.tolist(), float("nan")][rng.integers(8)]


def case(number: int) -> str:
    """Give an environment a hostile state; step it if that is taken."""
    rng = np.random.default_rng((1, number))
    env, states = world(int(rng.integers(len(ENVIRONMENTS))))
    good = states[rng.integers(1, len(states))]
    env.set_state(good)
    state = dict(states[rng.integers(len(states))])
    for _ in range(rng.integers(1, 4)):
        name = rng.choice([n for n in state if n != "scenario"])
        old = state[name]
        if rng.random() < 0.05:
            del state[name]
        else:
            state[name] = hostile(rng, old) if isinstance(old, np.ndarray) else other(rng, name, old)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return taken(env, good, state, rng)


def other(rng: np.random.Generator, name: str, old: Any) -> Any:
    """Return something else in place of agents or observers."""
    pool: list[Any] = [None, [], {}, [5], [{}], ["vehicle_1"] * 9, [["x"]], "vehicle_1", ["vehicle_9"], [old], 7]
    if name == "observers" and rng.random() < 0.7:
        new = copy.deepcopy(old)
        part = new[0] if isinstance(new, list) and new else {}
        if part:
            key = rng.choice(list(part))
            part[key] = pool[rng.integers(len(pool))]
        return new
    return pool[rng.integers(len(pool))]


def taken(env: Any, good: Any, state: Any, rng: np.random.Generator) -> str:
    """Set a state; nothing changes if it is refused, and nothing is NaN for some steps if it is not."""

    def go_on(_: None) -> None:
        for _ in range(STEPS):
            if not env.agents:
                break
            actions = {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}
            observations, rewards, *_ = env.step(actions)
            for agent in observations:
                assert np.isfinite(observations[agent]).all() and np.isfinite(rewards[agent]), agent
            assert np.isfinite(env.state()).all()
            env.set_state(env.get_state())

    outcome = harness.taken(lambda: env.set_state(state), go_on)
    assert outcome != "refused" or same(env.get_state(), good), "a refused state has changed something"
    return outcome


def same(a: Any, b: Any) -> bool:
    """Return whether the arrays of two states are the same, bit for bit."""
    return a.keys() == b.keys() and all(a[n].tobytes() == b[n].tobytes() for n in a if isinstance(a[n], np.ndarray))
