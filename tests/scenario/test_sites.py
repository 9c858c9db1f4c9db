"""Roads with any number of vehicles, against plain geometry: collisions, headways, landmarks, lines of sight."""

from __future__ import annotations

import math
import tomllib
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coopenv.estimation.poses import Array
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from coopenv.scenario.scenes import scene_text
from coopenv.scenario.sites import crossroad, road
from tests.scenario.test_scenes import SPEEDS, made, names

STEP = 0.1
"""m from one point of a line of sight to the next."""


class Traffic(NamedTuple):
    """Vehicles by the file alone: (N, 2) starts in m, (N, 2) velocities in m/s, and (N, 2) half sizes along x and y."""

    start: Array
    velocity: Array
    half: Array

    @classmethod
    def of(cls, name: str) -> Traffic:
        """Read the file of a scene, whose vehicles go along an axis each."""
        vehicles = tomllib.loads(scene_text(name))["vehicles"]
        yaw = np.array([v["initial_pose"].get("yaw", 0.0) for v in vehicles])
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        assert np.allclose(np.abs(along).max(axis=1), 1.0, atol=1e-5)
        assert all(v["motion"]["linear"][1:] == [0.0, 0.0] and "angular" not in v["motion"] for v in vehicles)
        speed = np.array([v["motion"]["linear"][0] for v in vehicles])
        size = np.array([v["body"]["size"][:2] for v in vehicles])
        across = np.abs(along[:, :1]) < 0.5
        start = np.array([v["initial_pose"]["position"][:2] for v in vehicles])
        return cls(start, speed[:, None] * along, np.where(across, size[:, ::-1], size) / 2)

    def least_gap(self, time: float) -> float:
        """Return the least gap of two boxes at a time in s, m; below 0 where they overlap."""
        at = self.start + time * self.velocity
        gap = (np.abs(at[:, None] - at) - self.half[:, None] - self.half).max(axis=-1)
        return float(gap[~np.eye(len(at), dtype=bool)].min())


@settings(max_examples=12, deadline=None)
@given(names(["road", "crossroad"]))
def test_vehicles_never_touch(name: str) -> None:
    traffic = Traffic.of(name)
    assert min(traffic.least_gap(t) for t in np.arange(0.0, 60.0, 0.05)) > 0.4


@pytest.mark.parametrize("kind", ["road", "crossroad"])
def test_separations_grow_with_speed(kind: str) -> None:
    """Of two vehicles in a lane, the gap is at least the headway of 1.5 s, and both are as fast."""
    for speed in (2.0, 10.0, 25.0, 50.0):
        traffic, pairs = Traffic.of(f"{kind}:12,speed={speed}"), 0
        for i, j in np.argwhere(~np.eye(12, dtype=bool)):
            fast = np.linalg.norm(traffic.velocity[i])
            ahead = traffic.start[j] - traffic.start[i]
            along = float(ahead @ traffic.velocity[i] / fast)
            same = np.allclose(traffic.velocity[i], traffic.velocity[j]) and np.linalg.norm(ahead) < along + 0.01
            pairs += same
            assert not same or along - 5.5 >= 1.5 * fast
        assert pairs > 10


@settings(max_examples=8, deadline=None)
@given(st.integers(2, 20), SPEEDS, st.integers(1, 2))
def test_landmarks_are_in_range_for_fifty_seconds(vehicles: int, speed: float, lanes: int) -> None:
    for name in (f"road:{vehicles},speed={speed},lanes={lanes}", f"crossroad:{vehicles},speed={speed}"):
        file, traffic = tomllib.loads(scene_text(name)), Traffic.of(name)
        marks = np.array([mark["position"][:2] for mark in file["landmarks"]])
        for t in np.linspace(0.0, file["horizon"], 26):
            far = np.linalg.norm((traffic.start + t * traffic.velocity)[:, None] - marks, axis=-1)
            assert (far < file["camera"]["range"]).any(axis=1).all()


def hit(start: Array, end: Array, low: Array, high: Array, margin: float) -> bool:
    """Return whether a line from start to end meets a box that is larger by a margin, m."""
    share = np.linspace(0.0, 1.0, math.ceil(np.linalg.norm(end - start) / STEP))[:, None]
    points = start + share * (end - start)
    return bool(((points > low - margin) & (points < high + margin)).all(axis=1).any())


def sights(name: str, ticks: NDArray[np.int64]) -> tuple[Recording, dict[bool, int]]:
    """Compare what is visible at some ticks with lines of sight; return the record, and how many are free or not."""
    scenario = made(name)
    r, file = record(scenario, 3), tomllib.loads(scene_text(name))
    origin = np.array(file.get("map", {}).get("origin", [0.0, 0.0, 0.0]))
    size = np.array([v["body"]["size"] for v in file["vehicles"]])
    walls = [(np.array(b["center"]) - origin, np.array(b["size"]) / 2) for b in file.get("obstacles", ())]
    L, N, found = len(file["landmarks"]), len(size), {True: 0, False: 0}
    for k in ticks:
        p, R = r.truth.position[k], r.truth.rotation[k]
        cars = [(p[n] + [0, 0, size[n, 2] / 2], np.abs(R[n] @ size[n]) / 2) for n in range(N)]
        targets = np.concatenate([r.landmarks[k], p + np.array([0.0, 0.0, 1.0])])
        for i in range(N):
            eye = p[i] + R[i] @ [0.5, 0.0, 1.3]
            for n in range(L + i):
                others = [*walls, *(cars[j] for j in range(N) if j not in (i, n - L))]
                far = float(np.linalg.norm(targets[n] - eye))
                near = far < 80.0
                hidden = near and any(hit(eye, targets[n], c - h, c + h, -STEP) for c, h in others)
                free = near and not any(hit(eye, targets[n], c - h, c + h, STEP) for c, h in others)
                if hidden or free or not near:
                    assert r.visible[k, i, n] == free, (k, i, n)
                found[free] += near and (hidden or free)
    return r, found


def test_vehicles_hide_what_is_behind_them() -> None:
    _, found = sights("road:8,speed=12", np.arange(20, 500, 90))
    assert found[True] > 50 and found[False] > 10


def test_buildings_hide_the_other_road() -> None:
    """In the crossing both roads are in view, before it only the own one."""
    r, found = sights("crossroad:6", np.arange(20, 260, 30))
    assert found[True] > 50 and found[False] > 50
    first, south = 0, len(r.landmarks[0]) + 2  # vehicle_1 goes east, vehicle_3 north, and arrives 2.2 s later
    seen = r.visible[:, 2, len(r.landmarks[0]) + first]
    along = r.truth.position[:, 0, 0]
    assert not seen[(along > -60.0) & (along < -12.0)].any() and seen[np.abs(along) < 2.0].all()
    assert not r.visible[:, first, south].any()  # acyclic: no vehicle measures a later one


def test_names_of_landmarks_and_the_order_of_vehicles() -> None:
    """The front vehicle is the first of a road, and pairs from opposite sides take turns in the crossing."""
    ahead = [vehicle.position[0] for vehicle in road(9, 20.0, 2).vehicles]
    assert ahead == sorted(ahead, reverse=True)
    yaws = [round(vehicle.yaw / math.pi * 2) for vehicle in crossroad(6, 10.0).vehicles]
    assert yaws == [0, 2, 1, 3, 0, 2]
    assert {vehicle.velocity[0] for vehicle in road(9, 20.0, 2).vehicles} == {20.0, 22.0}
    assert {vehicle.velocity[0] for vehicle in road(9, 20.0, 1).vehicles} == {20.0}


@pytest.mark.parametrize("name", ["road:4", "crossroad:4"])
def test_filters_follow_vehicles_at_speed(name: str) -> None:
    """Both filters fall from a metre to decimetres, and the paper's observer, which is slower, to a metre or two."""
    recording = record(made(name, horizon=9.0), 1)
    for observer, bound in (("robust", 0.25), ("schmidt_kalman", 0.25), ("riccati", 5.0)):
        result = run(observer, recording)
        assert not result.failure and (result.position_rmse(6.0) < bound).all(), (observer, result.position_rmse(6.0))
