"""Frames of fake cameras against an independent projection: pinhole and plumb-bob lens in NumPy, boxes by sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.cars.profile import Role
from coopenv.cars.readings import Calibration, bearings, detections, read
from tests.helpers.fakes import CROSSING, EXACT, MARKERS, OVERTAKING, Stage

FOCAL, CENTRE, SIZE = (213.161906, 213.521038), (154.841998, 114.98398), (316, 208)
DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
CALIBRATION = Calibration(SIZE, FOCAL, CENTRE, DISTORTION)
CAMERA, MARKER = np.array([0.3218, 0.0, 0.2233]), np.array([0.16, 0.0, 0.25])
BOX, BOX_CENTRE = np.array([0.586, 0.25, 0.25]), np.array([0.16, 0.0, 0.125])


def turned(yaw: float) -> np.ndarray:
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


def pixel(position: np.ndarray, yaw: float, target: np.ndarray) -> np.ndarray | None:
    """Return the exact pixel of a point; None: behind, beyond what the lens images, or beside the image."""
    forward, left, up = turned(yaw).T @ (target - position) - CAMERA
    if forward <= 0.0:
        return None
    x, y = -left / forward, -up / forward
    r2 = x * x + y * y
    k1, k2, p1, p2, _ = DISTORTION
    if 1.0 + 3.0 * k1 * r2 + 5.0 * k2 * r2 * r2 <= 0.0:  # the image of a ray farther out comes back
        return None
    g = 1.0 + k1 * r2 + k2 * r2**2
    u = FOCAL[0] * (x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + CENTRE[0]
    v = FOCAL[1] * (y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + CENTRE[1]
    return np.array([u, v]) if 0 <= u < SIZE[0] and 0 <= v < SIZE[1] else None


def hides(position: np.ndarray, yaw: float, target: np.ndarray, other: np.ndarray, other_yaw: float) -> bool | None:
    """Return whether the box of a car is before a target; None: only just."""
    eye = position + turned(yaw) @ CAMERA
    points = eye + np.linspace(0.0, 1.0, 4001)[:, None] * (target - eye)
    inside = np.abs((points - other) @ turned(other_yaw) - BOX_CENTRE) / (BOX / 2)
    depth = inside.max(axis=-1).min()
    return None if 0.97 < depth < 1.03 else bool(depth < 1.0)


def places(stage: Stage) -> dict[int, np.ndarray]:
    """Return where static markers are, by number."""
    return {MARKERS[mark.name]: np.array(mark.position) for mark in stage.scenario.landmarks if mark.name in MARKERS}


def put(stage: Stage, car: str, x: float, y: float, yaw: float) -> None:
    world = stage.cars[car].world
    world.put(world.agent, turned(yaw), np.array([x, y, 0.0]))


def frame(stage: Stage, car: str) -> tuple[Any, Any]:
    """Return the last frame as blocks and as the authors' bearings."""
    stage.forget()
    stage.run(0.04)
    return stage.arrivals(car, Role.DETECTIONS)[-1], stage.arrivals(car, Role.BEARINGS)[-1]


def test_pixels_of_many_poses() -> None:
    stage, rng = Stage("svea_overtaking", OVERTAKING, EXACT), np.random.default_rng(1)
    seen, unseen = 0, 0
    for _ in range(60):
        x, y, yaw = rng.uniform(-1.5, 1.5), rng.uniform(-2.0, 1.5), np.pi / 2 + rng.uniform(-0.8, 0.8)
        put(stage, "svea7", x, y, yaw)
        put(stage, "svea8", 20.0, 20.0, 0.0)
        blocks, unit = frame(stage, "svea7")
        found = {b.signature: (b.center_x, b.center_y) for b in blocks.objects}
        for number, place in places(stage).items():
            exact = pixel(np.array([x, y, 0.0]), yaw, place)
            if exact is None:
                assert number not in found
                unseen += 1
                continue
            assert_allclose(found[number], np.minimum(np.round(exact), [315, 207]), atol=0)
            seen += 1
        assert [b.id for b in unit.bearing] == [b.signature for b in blocks.objects]
        for b, g in zip(blocks.objects, unit.bearing, strict=True):
            v = np.array([(CENTRE[0] - b.center_x) / FOCAL[0], (CENTRE[1] - b.center_y) / FOCAL[1], -1.0])
            assert_allclose([g.bearing_x, g.bearing_y, g.bearing_z], v / np.linalg.norm(v), atol=1e-6)
    assert seen > 60 and unseen > 20


def test_cars_see_each_other_and_hide_what_is_behind() -> None:
    """The other car is where motion capture has it: a message of another fake."""
    stage, rng = Stage("svea_overtaking", OVERTAKING, EXACT), np.random.default_rng(2)
    hidden, cars = 0, 0
    for _ in range(60):
        x, y, yaw = rng.uniform(-0.5, 0.5), rng.uniform(-2.0, 0.0), np.pi / 2 + rng.uniform(-0.3, 0.3)
        ox, oy, oyaw = x + rng.uniform(-0.5, 0.5), y + rng.uniform(0.8, 2.0), rng.uniform(-3.0, 3.0)
        put(stage, "svea8", x, y, yaw)
        put(stage, "svea7", ox, oy, oyaw)
        found = {b.signature for b in frame(stage, "svea8")[0].objects}
        position, other = np.array([x, y, 0.0]), np.array([ox, oy, 0.0])
        carried = other + turned(oyaw) @ MARKER
        assert (7 in found) == (pixel(position, yaw, carried) is not None)
        cars += 7 in found
        for number, place in places(stage).items():
            blocked = hides(position, yaw, place, other, oyaw)
            if blocked is not None:
                assert (number in found) == (pixel(position, yaw, place) is not None and not blocked)
                hidden += blocked
    assert hidden > 10 and cars > 30


def test_a_leader_sees_its_follower_too() -> None:
    """A camera knows nothing of the order in which vehicles may hear each other."""
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    put(stage, "svea7", 0.0, -2.0, np.pi / 2)
    put(stage, "svea8", 0.1, -1.0, np.pi / 2)
    assert 6 in {b.signature for b in frame(stage, "svea7")[0].objects}


def test_blocks_are_as_large_as_they_are_near_and_the_largest_comes_first() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    put(stage, "svea8", 20.0, 0.0, 0.0)
    sizes = []
    for y in (-2.5, -1.0, 0.0):
        put(stage, "svea7", 0.0, y, np.pi / 2)
        blocks = frame(stage, "svea7")[0].objects
        areas = [b.width * b.height for b in blocks]
        assert areas == sorted(areas, reverse=True)
        sizes.append(areas[0])
    assert sizes == sorted(sizes) and sizes[0] < sizes[2]
    assert all(1 <= b.age <= 255 for b in blocks)
    assert max(b.age for b in blocks) > 2


def test_an_empty_frame_is_a_frame() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    put(stage, "svea7", 0.0, 0.0, -np.pi / 2)
    put(stage, "svea8", 0.0, 1.5, 0.0)
    stage.run(0.04)
    stage.forget()
    stage.run(1.0)
    frames = stage.arrivals("svea7", Role.DETECTIONS)
    assert len(frames) == pytest.approx(60, abs=2) and not any(m.objects for m in frames)


def test_both_topics_are_read_as_the_same_rays() -> None:
    stage = Stage("svea_overtaking", OVERTAKING)
    put(stage, "svea7", 0.0, -1.0, np.pi / 2)
    blocks, unit = frame(stage, "svea7")
    a, b = detections(blocks, CALIBRATION, None), bearings(unit, CALIBRATION, None)
    assert a.markers == b.markers and len(a.markers) >= 4
    assert_allclose(a.bearings, b.bearings, atol=1e-5)
    for number, ray in zip(a.markers, a.bearings, strict=True):
        if number in places(stage):
            forward, left, up = turned(np.pi / 2).T @ (places(stage)[number] - [0.0, -1.0, 0.0]) - CAMERA
            true = np.array([-left, -up, forward]) / np.linalg.norm([forward, left, up])
            assert np.arccos(min(ray @ true, 1.0)) < 0.015  # half a pixel and the noise
    stage.run(1.1)
    told = read(Role.CAMERA_INFO, stage.arrivals("svea7", Role.CAMERA_INFO)[-1])
    assert told == CALIBRATION


def test_the_moving_landmark_is_seen_once_its_car_is_there() -> None:
    both, alone = (Stage("svea_crossing", cars, EXACT) for cars in (CROSSING, CROSSING[:1]))
    for stage, expected in ((both, True), (alone, False)):
        stage.reset(0)
        stage.run(7.0)
        put(stage, "svea7", 0.0, -1.0, np.pi / 2)
        assert (3 in {b.signature for b in frame(stage, "svea7")[0].objects}) == expected
