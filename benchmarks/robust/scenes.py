"""Scenes of the studies: deep graphs, drawn scenes, lying senders, vehicles that start lost."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from coopenv.scenario import Scenario, load_scenario

ROBUST = {"observer.name": "robust"}
DEEP: dict[str, tuple[str, dict[str, float]]] = {
    "`lane:8`": ("lane:8", {}),
    "`lane:8`, messages 50 ms late": ("lane:8", {"v2x.delay": 3}),
    "`lane:8`, 30 % of messages lost": ("lane:8", {"v2x.loss": 0.3}),
    "`lane:20`": ("lane:20", {}),
    "`tree:20`": ("tree:20", {}),
    "`random:16,seed=7`": ("random:16,seed=7", {}),
    "`random:50,seed=9`": ("random:50,seed=9", {}),
    "`roots:10`": ("roots:10", {}),
    "`roots:14`": ("roots:14", {}),
    "`roots:14`, scale off by 10 %, little noise": ("roots:14", {"noise.velocity": 0.02, "noise.odometry_scale": 0.1}),
    "`lane:14,seen=5`, scale off by 5 %": ("lane:14,seen=5", {"noise.odometry_scale": 0.05}),
    "`ring:5`": ("ring:5", {}),
}
"""Graphs of messages by their title: the scene and the keys that are overridden."""


class Drawn(NamedTuple):
    """A drawn scene and its changes."""

    name: str
    overrides: dict[str, Any]
    scale: float
    """Factor of all lengths and speeds."""
    turn: float
    """Largest initial error of the orientation, rad."""
    offset: float
    """Largest initial error of the position, m."""


def draw(number: int) -> Drawn:
    """Return the drawn scene of a number."""
    random = np.random.default_rng(77000 + number)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    kind = str(random.choice(["lane", "roots", "tree", "random", "random", "ring"]))
    name = f"{kind}:{random.integers(4, 25)}"
    if kind in ("lane", "tree", "random"):
        name += f",seen={random.integers(2, 6)}"
    if kind == "ring":
        name += f",seen={random.integers(1, 3)}"
    if kind == "random":
        name += f",seed={random.integers(1000)}"
    camera = float(random.choice([10, 15, 20, 30, 60]))
    overrides: dict[str, Any] = {
        "rates.camera": camera,
        "rates.odometry": float(random.choice([10, 20, 50, 100, camera])),
        "rates.decision": 5.0,
        "noise.velocity": between(0.02, 0.4),
        "noise.angular_velocity": between(0.002, 0.05),
        "noise.bearing.scale": between(0.0005, 0.02),
        "v2x.period": int(max(1, round(camera * between(0.03, 0.5)))),
        "v2x.delay": int(random.choice([0, 1, round(camera * 0.1), round(camera * 0.2)])),
        "v2x.loss": float(random.choice([0.0, 0.0, 0.1, 0.3, 0.5])),
    }
    for key, chance, low, high in (
        ("noise.gyro_bias", 0.3, 0.003, 0.03),
        ("noise.odometry_scale", 0.3, 0.01, 0.06),
        ("camera.extrinsics_error", 0.2, 0.003, 0.03),
    ):
        if random.random() < chance:
            overrides[key] = between(low, high)
    if random.random() < 0.2:
        overrides["camera.position"] = random.uniform(-1.0, 1.0, 3).tolist()
    scale = between(0.5, 20.0)
    return Drawn(name, overrides, scale, between(0.02, 0.35), between(0.1, 2.0) * max(1.0, scale**0.5))


def built(drawn: Drawn) -> Scenario:
    """Return the scenario of a drawn scene."""
    raw = load_scenario(drawn.name, {**ROBUST, "horizon": 41.0, **drawn.overrides}).model_dump()

    def longer(values: Any) -> tuple[float, ...]:
        return tuple(drawn.scale * value for value in values)

    for mark in raw["landmarks"]:
        mark["position"] = longer(mark["position"])
    for vehicle in raw["vehicles"]:
        for part in (vehicle["motion"], *vehicle["motion"].get("segments", ())):
            if "linear" in part:
                part["linear"] = longer(part["linear"])
        vehicle["initial_pose"]["position"] = longer(vehicle["initial_pose"]["position"])
        vehicle["initial_estimate"] |= {"orientation_angle": drawn.turn, "position_radius": drawn.offset}
    return Scenario(**raw)


SEEN = (
    ("SL1", "SL2", "SL3"),
    ("SL1", "SL2", "SL3", "vehicle_1"),
    ("SL2", "SL3", "vehicle_1", "vehicle_2"),
    ("SL2", "SL3", "vehicle_1", "vehicle_2", "vehicle_3"),
    ("SL3", "vehicle_1", "vehicle_2", "vehicle_3", "vehicle_4"),
)
"""Targets of each vehicle in the scene with lying senders: at least two honest ones."""


def with_liars(
    liars: tuple[int, ...] = (), horizon: float = 50.0, *, overrides: dict[str, Any] | None = None, **lie: Any
) -> Scenario:
    """Return the paper's five vehicles with the targets `SEEN`, of which some broadcast a lie.

    Args:
        liars: indices of the lying vehicles.
        horizon: s.
        overrides: keys of the scenario.
        lie: keys of `faults.lie`.
    """
    raw = load_scenario("busy_intersection_tracking", {**ROBUST, "horizon": horizon, **(overrides or {})}).model_dump()
    for vehicle, seen in zip(raw["vehicles"], SEEN, strict=True):
        vehicle["neighbours"] = seen
    for n in liars:
        raw["vehicles"][n]["faults"] = {"lie": lie}
    return Scenario(**raw)


HONEST = {"odometry": "honest"}
"""Without it, the odometry in messages agrees with the lie."""
LIES: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "the first from its first message on, 5 m": ((0,), {"kind": "jump", **HONEST}),
    "the second from its first message on, 5 m": ((1,), {"kind": "jump", **HONEST}),
    "the second from 15 s on, 5 m": ((1,), {"kind": "jump", "start": 15.0, **HONEST}),
    "the second from 15 s on, 5 m, consistent": ((1,), {"kind": "jump", "start": 15.0}),
    "the second turns by 30 deg from 15 s on": ((1,), {"kind": "jump", "start": 15.0, "offset": 0.0, "turn": 0.52}),
    "the second drifts at 5 cm/s from 15 s on": ((1,), {"kind": "drift", "start": 15.0, **HONEST}),
    "the second drifts at 5 cm/s from 15 s on, consistent": ((1,), {"kind": "drift", "start": 15.0}),
    "the third drifts at 5 cm/s from 15 s on": ((2,), {"kind": "drift", "start": 15.0, **HONEST}),
    "the second repeats itself 1 s late from 15 s on": ((1,), {"kind": "replay", "start": 15.0}),
    "the first two collude from 15 s on, 5 m": ((0, 1), {"kind": "collude", "start": 15.0, **HONEST}),
    "the first two collude from 15 s on, 5 m, consistent": ((0, 1), {"kind": "collude", "start": 15.0}),
}
"""Liars and their lie by its title."""

LOST = {
    "position": None,
    "position_radius": 15.0,
    "orientation_angle": np.pi,
    "orientation_offset_wxyz": [1.0, 0.0, 0.0, 0.0],
}
"""An initial estimate up to 15 m and 180 degrees from the truth, with a covariance that states this."""


def all_lost(name: str, seconds: float) -> Scenario:
    """Return a scene in which all vehicles start lost."""
    return load_scenario(name, {**ROBUST, "horizon": seconds + 1.0, "vehicles.*.initial_estimate": LOST})
