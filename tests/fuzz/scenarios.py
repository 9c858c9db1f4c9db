"""Scenario files with other numbers, types, names, structure or characters in them."""

from __future__ import annotations

import copy
import math
import tempfile
import tomllib
import warnings
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import coopenv
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.scenario.own_terms import located
from tests.fuzz.harness import go_through, taken

STEPS = 5
FINITE = (
    *("position", "rotation", "velocity", "estimate_position", "estimate_rotation", "covariance", "position_error"),
    *("orientation_error", "nees", "log_determinant", "gramian_min_eigenvalue", "increment_rotation", "bearing"),
)
NUMBERS = (
    *(0.0, -0.0, 1.0, -1.0, 1e-300, 1e-12, 1e-6, 1e6, 9.9e8, 1e9, -1e9, 1.1e9, 1e35, 1e99, 1e308),
    *(math.inf, math.nan),
)
SCALES = (0.5, 2.0, 3.0, -1.0, 1e-9, 1e-3, 10.0, 1e3, 1e6, 1.0 + 1e-12)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 10**9, 2**31, 2**63, 10**30),
    *("", "x", "vehicle_1", "uniform", "sample", "a" * 3000, "\x1b[2J\x07", "\ud800", "\u202e", "0", "1e9", "nan"),
    *("~nosuchuser/a.py:f", "x\0.py:f", "a" * 5000 + ".py:f", "nowhere.py:f", "no.such.module:f", ":", {"a": "b.py:c"}),
    *([], {}, [[]], [0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], {"kind": "driven"}, {"kind": "x"}, [None] * 3),
    {"kind": "waypoints", "waypoints": [{"time": 0.0, "position": [0, 0, 0]}, {"time": 1e8, "position": [9, 0, 0]}]},
    {"kind": "segments", "segments": [{"duration": 1e9, "linear": [1.0, 0, 0], "angular": [0, 0, 1e9]}]},
    {"kind": "constant", "linear": [1e9, 0, 0], "angular": [0, 0, 1.0]},
)


@cache
def documents() -> list[tuple[str, dict[str, Any]]]:
    """Return text and contents of the shipped environments."""
    from coopenv.base.installation import data_directory

    paths = sorted(data_directory("envs").glob("*.toml"))
    if find_spec("libsumo") is None:
        paths = [path for path in paths if not path.name.startswith("sumo")]
    return [(path.read_text(), located(tomllib.loads(path.read_text()), path.parent)) for path in paths]


def prepare() -> None:
    """Compile what the cases run in: sources and observers have kernels of their own."""
    scenarios = [coopenv.load_scenario(data) for _, data in documents()]
    for scenario in {(made.backend, made.observer.k): made for made in scenarios}.values():
        for observer in ("riccati", "robust"):
            run(scenario.model_copy(update={"observer": scenario.observer.model_copy(update={"name": observer})}), 0)


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of everything in a document."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path, *(place for key, value in inner for place in places(value, (*path, key)))]


def at(node: Any, path: Sequence[Any]) -> Any:
    """Return what stands at a path."""
    for part in path:
        node = node[part]
    return node


def mutate(rng: np.random.Generator, data: dict[str, Any]) -> None:
    """Change one thing."""
    found = places(data)[1:]
    if rng.random() < 0.7:
        found = [place for place in found if isinstance(at(data, place), float)] or found
    *path, last = found[rng.integers(len(found))]
    node, kind = at(data, path), rng.integers(8)
    old = node[last]
    if isinstance(old, int | float) and not isinstance(old, bool) and kind < 6:
        node[last] = float(rng.choice(NUMBERS)) if kind < 2 else old * float(rng.choice(SCALES))
    elif kind == 6 and isinstance(node, list):
        node.insert(int(rng.integers(len(node) + 1)), copy.deepcopy(node[rng.integers(len(node))]))
    elif kind == 6:
        node[str(rng.choice(["nosie", "kind", "motion", "body", "goal", last]))] = node.pop(last)
    elif kind == 7:
        del node[last]
    else:
        node[last] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])


def stretch(rng: np.random.Generator, data: dict[str, Any]) -> None:
    """Scale many numbers alike: all in a section, or all of one name."""
    name = rng.choice(["position", "size", "linear", "noise", "observer", "camera", "dynamics", "weights"])
    scale = 10.0 ** float(rng.integers(-9, 9))
    for *path, last in places(data)[1:]:
        node = at(data, path)
        if name in (*path, last) and isinstance(node[last], float):
            node[last] *= scale


def case(number: int) -> str:
    """Load a mutated scenario; run it if it is taken."""
    rng = np.random.default_rng((2, number))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return taken(lambda: changed(rng), lambda scenario: run(scenario, int(rng.integers(100))), most=399)


def changed(rng: np.random.Generator) -> Any:
    """Return a mutated scenario."""
    text, data = documents()[rng.integers(len(documents()))]
    if rng.random() < 0.2:
        return from_text(rng, text)
    data = copy.deepcopy(data)
    if rng.random() < 0.5:
        data["observer"] = {**data.get("observer", {}), "name": str(rng.choice(["riccati", "robust"]))}
    if rng.random() < 0.2:
        stretch(rng, data)
    if rng.random() < 0.1:
        section = str(rng.choice(["observation", "reward", "termination"]))
        custom = {"mine": VALUES[rng.integers(len(VALUES))]}
        data[section] = {**data.get(section, {}), "custom": custom}
    for _ in range(rng.integers(1, 3)):
        mutate(rng, data)
    return coopenv.load_scenario(data)


def from_text(rng: np.random.Generator, text: str) -> Any:
    """Return the scenario of a file some of whose bytes are others."""
    data = bytearray(text.encode())
    for _ in range(rng.integers(1, 6)):
        k = int(rng.integers(len(data)))
        if rng.random() < 0.5:
            data[k] = int(rng.integers(256))
        elif rng.random() < 0.5:
            del data[k : k + int(rng.integers(1, 40))]
        else:
            data[k:k] = rng.choice([b"[[", b"]", b"\n", b"\0", b"9" * 400, b"a.b.", b'"', b"e99", b"-"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.toml"
        path.write_bytes(bytes(data))
        return coopenv.load_scenario(path)


def run(scenario: Any, seed: int) -> None:
    """Run a scenario for some steps in both precisions."""
    for dtype in ("float32", "float64"):
        env = CooperativeLocalisationEnv(scenario, "mutated", dtype=dtype)
        go_through(env, STEPS, seed)
        for name in FINITE:
            assert np.isfinite(env.engine.view(name)).all(), (dtype, name)
