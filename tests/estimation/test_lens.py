"""Distortion of lenses beside OpenCV and the simulator, and its inverse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coopenv.estimation.lens import distort, largest_radius, undistort
from coopenv.world.camera import undistort as simulated

DISTORTION = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
LENSES = {
    "plumb_bob": (-0.30, 0.10, 0.002, 0.0006, 0.0),
    "rational": (0.3, -0.1, 0.001, -0.0007, 0.02, 0.6, 0.05, 0.003),
    "fisheye": (-0.03, 0.01, -0.004, 0.001),
}
FISH = (-0.4, 0.0, 0.001, -0.002, 0.0)  # folds back beyond a radius of 0.91
CUSHION = (0.3, 0.1, 0.0, 0.001, 0.02)


@wp.struct
class Lens:
    k1: wp.float64
    k2: wp.float64
    p1: wp.float64
    p2: wp.float64
    k3: wp.float64


@wp.kernel
def undistort_all(lens: Lens, points: wp.array(dtype=wp.vec2d), found: wp.array(dtype=wp.vec2d)):  # type: ignore[valid-type]
    i = wp.tid()
    x, y = simulated(lens, points[i][0], points[i][1])
    found[i] = wp.vec2d(x, y)


coordinates = st.floats(-0.7, 0.7)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=7), st.sampled_from([DISTORTION, FISH, CUSHION])
)
def test_undistorted_points_are_imaged_where_they_were(points: list[tuple[float, float]], distortion: Any) -> None:
    true = np.array(points)
    true = true[np.linalg.norm(true, axis=1) < 0.95 * min(largest_radius(distortion), 9.0)]
    found, there = undistort(distort(true, distortion), distortion)
    assert there.all()
    assert_allclose(found, true, atol=1e-8)


def test_the_simulator_undistorts_alike() -> None:
    points = np.random.default_rng(2).uniform(-0.45, 0.45, (50, 2))
    found, there = undistort(points, DISTORTION)
    lens = Lens()
    for name, value in zip(("k1", "k2", "p1", "p2", "k3"), DISTORTION, strict=True):
        setattr(lens, name, value)
    out = wp.zeros(50, dtype=wp.vec2d, device="cpu")
    wp.launch(undistort_all, dim=50, inputs=[lens, wp.array(points, dtype=wp.vec2d, device="cpu"), out], device="cpu")
    assert there.all()
    assert_allclose(found, out.numpy(), atol=2e-5)  # whose fixed-point iteration stops after 20 rounds


def test_points_that_no_ray_gives_are_reported() -> None:
    reach = largest_radius(FISH)
    farthest = float(distort(np.array([[reach, 0.0]]), (*FISH[:2], 0.0, 0.0, 0.0))[0, 0])
    points = np.array([[0.1, 0.2], [farthest + 0.05, 0.0], [np.nan, 0.0], [0.0, 50.0]])
    found, there = undistort(points, FISH)
    assert there.tolist() == [True, False, False, False]
    assert_allclose(distort(found[:1], FISH), points[:1], atol=1e-12)


def test_far_points_of_a_lens_without_end_are_found() -> None:
    true = np.array([[3.0, -4.0], [0.0, 12.0], [1e-9, 0.0]])
    found, there = undistort(distort(true, CUSHION), CUSHION)
    assert there.all()
    assert_allclose(found, true, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_lenses_are_those_of_opencv(name: str) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs the extra 'vision'")
    flat, d = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 2)), np.array(LENSES[name])
    points = np.concatenate([flat, np.ones((200, 1))], axis=-1)[:, None]
    project = cv2.fisheye.projectPoints if len(d) == 4 else cv2.projectPoints
    expected = project(points, np.zeros(3), np.zeros(3), np.eye(3), d)[0].reshape(-1, 2)
    np.testing.assert_allclose(distort(flat, LENSES[name]), expected, atol=1e-12)
    found, there = undistort(expected, LENSES[name])
    assert there.all()
    np.testing.assert_allclose(found, flat, atol=1e-9)
