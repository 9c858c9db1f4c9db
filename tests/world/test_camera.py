"""Visibility, against plain geometry on random scenes, and measurements: pixels, distortion, noise."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.estimation import Sight
from coopenv.world import camera
from coopenv.world.launch import compiler_options
from coopenv.world.model import entry_struct, precision
from tests.helpers.builders import landmark, quaternion_wxyz, run, scenario, start, vehicle
from tests.helpers.warp_calls import DTYPES, Calls
from tests.oracles import geometry

call = Calls(__name__, {camera.segment_hits_box: "3 3 1 33 3 3 > b"})
PIXY = {"fx": 213.161906, "fy": 213.521038, "cx": 154.841998, "cy": 114.98398}
SIZE = {"width": 316, "height": 208}
PLUMB_BOB = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)
PINHOLE = {"model": "pinhole", "orientation": "forward"}
SENSED = {"mode": "sensed"}


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    return Rotation.random(count, rng).as_matrix()


def test_a_target_is_in_view_up_to_each_edge_of_the_image() -> None:
    """Half a pixel to either side of an edge; tests/world/test_nearby.py has ranges and what hides a target."""
    pixels = [(u, 100.0) for u in (-0.5, 0.5, SIZE["width"] - 0.5, SIZE["width"] + 0.5)]
    pixels += [(150.0, v) for v in (-0.5, 0.5, SIZE["height"] - 0.5, SIZE["height"] + 0.5)]
    lever, R = np.array([0.3, 0.1, 0.2]), Rotation.from_rotvec([0.3, -0.4, 2.0]).as_matrix()
    rays = [np.array([1.0, -(u - PIXY["cx"]) / PIXY["fx"], -(v - PIXY["cy"]) / PIXY["fy"]]) for u, v in pixels]
    places = [np.array([1.0, 2.0, 3.0]) + R @ (lever + side * ray) for side in (4.0, -4.0) for ray in rays]
    made = scenario(
        [{"initial_pose": {"position": [1, 2, 3], "quaternion_wxyz": quaternion_wxyz(R)}}],
        landmarks=[landmark(f"L{n}", place.tolist()) for n, place in enumerate(places)],
        camera={**PINHOLE, "position": lever.tolist()},
        topology=SENSED,
    )
    for dtype in DTYPES:
        seen = start(made, 0, dtype).get_state()["sight"][0, 0, : len(places)] == Sight.VISIBLE
        assert seen.tolist() == 2 * [False, True, True, False] + 8 * [False]


@pytest.mark.parametrize("dtype", DTYPES)
def test_segment_against_box(dtype: str) -> None:
    rng = np.random.default_rng(5)
    count = 20000
    a, b, c = rng.uniform(-2, 2, (3, count, 3))
    b[:2000] = a[:2000] + np.eye(3)[rng.integers(0, 3, 2000)] * rng.uniform(-4, 4, (2000, 1))  # along an axis
    R, half = rotations(rng, count), rng.uniform(0.1, 1.5, (count, 3))
    R[:4000] = np.eye(3)
    depth = geometry.depth_by_enumeration(a, b, c, R, half)
    clear = np.abs(depth) > (1e-9 if dtype == "float64" else 1e-5)
    hits = call(camera.segment_hits_box, dtype, a, b - a, 1.0 / np.sum((b - a) ** 2, axis=1), R, c, half)
    assert (hits == (depth > 0))[clear].all()
    assert 0.1 < hits.mean() < 0.9
    assert clear.mean() > 0.99


def test_own_body_and_the_targets_body_do_not_hide() -> None:
    """The camera sits inside its own body, the marker inside the target's."""
    body = {"size": [2.0, 1.0, 1.0]}
    state = start(
        scenario(
            [vehicle((0, 0, 0), body=body), vehicle((6, 0, 0), body=body)],
            landmarks=[landmark("A", (-5, 0, 0), body=body), landmark("B", (12, 0, 0), body=body)],
            topology={"mode": "sensed", "acyclic": False},
        )
    ).get_state()
    assert state["sight"][0].tolist() == [
        [Sight.VISIBLE, Sight.OCCLUDED_BY_BODY, Sight.NOT_A_NEIGHBOUR, Sight.VISIBLE],
        [Sight.OCCLUDED_BY_BODY, Sight.VISIBLE, Sight.VISIBLE, Sight.NOT_A_NEIGHBOUR],
    ]


def test_fixed_topology_sees_through_everything() -> None:
    wall = {"name": "wall", "center": [1.0, 0, 0], "size": [0.2, 100, 100]}
    state = start(
        scenario(
            [vehicle((0, 0, 0), neighbours=["L1"]), vehicle((-1, 0, 0))],
            obstacles=[wall],
            camera={**PINHOLE, "range": 0.1},
        )
    ).get_state()
    assert state["sight"][0, 0].tolist() == [Sight.VISIBLE] + 5 * [Sight.NOT_A_NEIGHBOUR]
    assert (state["sight"][0, 1] == [1, 1, 1, 1, 1, 0]).all()


@pytest.mark.parametrize("orientation", ["forward", "body", [0.5, -0.5, 0.5, -0.5]])
def test_bearings_point_from_camera_to_marker(orientation: Any) -> None:
    rng = np.random.default_rng(1)
    R = rotations(rng, 1)[0]
    made = scenario(
        [{"initial_pose": {"position": [1, 2, 3], "quaternion_wxyz": quaternion_wxyz(R)}}],
        landmarks=[landmark("A", (4, 4, 4), yaw=0.5, marker=(0.3, 0.2, 0.1))],
        camera={"orientation": orientation, "position": [0.3, -0.2, 0.1]},
    )
    b = start(made).get_state()["bearing"][0, 0, 0]
    to_body = {"forward": geometry.OPTICAL_TO_BODY_FORWARD, "body": np.eye(3)}.get(
        orientation if isinstance(orientation, str) else "", geometry.OPTICAL_TO_BODY_FORWARD
    )
    if not isinstance(orientation, str):
        to_body = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
        assert_allclose(to_body, geometry.OPTICAL_TO_BODY_FORWARD, atol=1e-14)  # this quaternion looks forward
    marker = np.array([4, 4, 4]) + Rotation.from_euler("z", 0.5).apply([0.3, 0.2, 0.1])
    point = geometry.point_in_camera(marker, R, [1, 2, 3], (0.3, -0.2, 0.1), to_body)
    assert_allclose(b, point / np.linalg.norm(point), atol=1e-14)


def fan(**camera: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true optical-frame points (K, 3), measured bearings and visibility of 300 landmarks ahead."""
    rng = np.random.default_rng(2)
    yz = rng.uniform(-1, 1, (300, 2)) * [0.72, 0.55]
    depth = rng.uniform(1, 8, 300)
    place = np.column_stack([depth, -yz[:, 0] * depth, -yz[:, 1] * depth])
    landmarks = [landmark(f"L{i}", p) for i, p in enumerate(place.tolist())]
    made = scenario([vehicle((0, 0, 0))], landmarks=landmarks, camera={**PINHOLE, **camera}, topology=SENSED)
    state = start(made).get_state()
    return (
        geometry.point_in_camera(place, np.eye(3), np.zeros(3)),
        state["bearing"][0, 0, :300],
        state["sight"][0, 0, :300] == Sight.VISIBLE,
    )


def test_pixels_are_whole_and_within_half_a_pixel() -> None:
    point, b, visible = fan(quantise=True)
    assert 100 < visible.sum() < 300
    uv, true = geometry.project(b[visible], **PIXY), geometry.project(point[visible], **PIXY)
    assert_allclose(uv, np.round(uv), atol=1e-9)
    error = np.abs(uv - true)
    assert error.max() <= 0.5 + 1e-9
    assert error.max() > 0.45
    assert_allclose(np.linalg.norm(b[visible], axis=1), 1.0, atol=1e-12)


def test_distorted_lens_sees_what_its_image_holds() -> None:
    point, b, visible = fan(distortion=PLUMB_BOB)
    inside = geometry.in_field_of_view(point, **PIXY, **SIZE, distortion=PLUMB_BOB)
    np.testing.assert_array_equal(visible, inside)
    assert visible.sum() > fan()[2].sum()  # a barrel lens squeezes more into the image
    unit = point / np.linalg.norm(point, axis=1, keepdims=True)
    assert_allclose(b[visible], unit[visible], atol=1e-7)


def test_uncorrected_distortion_stays_in_the_bearing() -> None:
    point, b, visible = fan(distortion=PLUMB_BOB, undistort=False)
    uv = geometry.project(point[visible], **PIXY, distortion=PLUMB_BOB)
    assert_allclose(geometry.project(b[visible], **PIXY), uv, atol=1e-9)
    assert np.abs(uv - geometry.project(point[visible], **PIXY)).max() > 5.0


def test_quantised_and_distorted() -> None:
    point, b, visible = fan(distortion=PLUMB_BOB, quantise=True)
    uv = geometry.project(b[visible], **PIXY, distortion=PLUMB_BOB)
    assert_allclose(uv, np.round(uv), atol=1e-4)
    assert np.abs(uv - geometry.project(point[visible], **PIXY, distortion=PLUMB_BOB)).max() < 0.501


@wp.kernel(enable_backward=False, module="unique", module_options=compiler_options())
def there_and_back(lens: Any, xy: wp.array(dtype=Any), out: wp.array(dtype=Any), back: wp.array(dtype=Any)):
    i = wp.tid()
    x, y = camera.distort(lens, xy[i][0], xy[i][1])
    out[i] = type(xy[i])(x, y)
    x, y = camera.undistort(lens, x, y)
    back[i] = type(xy[i])(x, y)


LENSES = {dtype: entry_struct(precision(dtype), "camera") for dtype in DTYPES}
for dtype, lens_type in LENSES.items():
    wp.overload(there_and_back, [lens_type, *[wp.array(dtype=precision(dtype).vec2)] * 3])  # one module for both


def through_lens(dtype: str, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return image coordinates (K, 2) distorted by the kernels, and these undistorted again."""
    lens = LENSES[dtype]()
    lens.k1, lens.k2, lens.p1, lens.p2, lens.k3 = PLUMB_BOB
    given = wp.array(xy, dtype=precision(dtype).vec2, device="cpu")
    results = [wp.zeros_like(given), wp.zeros_like(given)]
    wp.launch(there_and_back, dim=len(xy), inputs=[lens, given, *results], device="cpu")
    distorted, back = (result.numpy().astype(float) for result in results)
    return distorted, back


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-7), ("float32", 2e-6)])
def test_distortion_and_back(dtype: str, tolerance: float) -> None:
    xy = np.random.default_rng(3).uniform(-1, 1, (500, 2)) * [0.75, 0.55]
    distorted, back = through_lens(dtype, xy)
    assert_allclose(distorted, geometry.distort_plumb_bob(xy, PLUMB_BOB), atol=1e-6 if dtype == "float32" else 1e-14)
    assert_allclose(back, xy, atol=tolerance)


def test_rays_beyond_the_turning_point_of_the_lens_do_not_fold_back() -> None:
    """With k1 = -0.5, r - r^3/2 turns round at 0.816: a ray at radius 1.2 would land at 0.336, inside the image."""
    made = scenario(
        [vehicle((0, 0, 0))],
        landmarks=[landmark("near", (1, 0.3, 0)), landmark("fold", (1, 1.2, 0)), landmark("behind", (-1, 0.3, 0))],
        camera={**PINHOLE, "distortion": [-0.5, 0, 0, 0, 0]},
        topology=SENSED,
    )
    assert start(made).get_state()["sight"][0, 0, :3].tolist() == [Sight.VISIBLE, Sight.OUT_OF_VIEW, Sight.OUT_OF_VIEW]


def test_noise_at_the_edge_of_the_lens_stays_at_the_edge() -> None:
    """A noisy ray just outside the image is still a ray near the image's edge."""
    made = scenario(
        [vehicle((0, 0, 0))],
        landmarks=[landmark("edge", (1, 0.81, 0))],
        camera={**PINHOLE, "distortion": [-0.5, 0, 0, 0, 0]},
        noise={"bearing": {"scale": 0.01}},
        topology=SENSED,
    )
    states = run(start(made, range(50)), 4)
    b = np.concatenate([s["bearing"][:, 0, 0] for s in states])
    true = np.array([-0.81, 0, 1]) / np.hypot(1, 0.81)
    assert np.degrees(np.arccos(np.clip(b @ true, -1, 1))).max() < 15.0


def bearings(noise: dict[str, Any], worlds: int = 200, ticks: int = 50, dtype: str = "float64", **more: Any) -> Any:
    """Return measured bearings (worlds * ticks, targets, 3) and the true ones (targets, 3)."""
    made = scenario([vehicle((0, 0, 0))], noise={"bearing": noise}, **more)
    states = run(start(made, range(worlds), dtype), ticks - 1, "bearing")
    b = np.concatenate([s["bearing"][:, 0, :-1] for s in states]).astype(float)
    place = np.array([p.position for p in made.landmarks])
    return b, place / np.linalg.norm(place, axis=1, keepdims=True)


def test_isotropic_noise() -> None:
    sigma = 0.005
    b, true = bearings({"model": "isotropic", "scale": sigma})
    assert_allclose(np.linalg.norm(b, axis=-1), 1.0, atol=1e-6)
    for j, t in enumerate(true):
        u = np.cross(t, [0.36, 0.48, 0.8])
        u /= np.linalg.norm(u)
        across = b[:, j] @ np.column_stack([u, np.cross(t, u)])
        assert_allclose(across.std(axis=0), sigma, rtol=4 / np.sqrt(2 * len(b)))
        assert np.abs(across.mean(axis=0)).max() < 4 * sigma / np.sqrt(len(b))
        assert abs(np.corrcoef(across.T)[0, 1]) < 4 / np.sqrt(len(b))
        assert stats.kstest(across[:, 0] / sigma, "norm").pvalue > 1e-4
    flat = (b - true).reshape(len(b), -1)
    between = np.corrcoef(flat[:, 0], flat[:, 3])[0, 1]  # targets are independent of one another
    assert abs(between) < 4 / np.sqrt(len(b))


def paper_frame(axis: np.ndarray) -> np.ndarray:
    """Return columns spanning the image plane across `axis`, and the axis; z has the camera's own x and y."""
    if axis[2] == 1.0:
        return np.eye(3)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_paper_noise_is_uniform_in_the_image_plane(axis: tuple[float, float, float]) -> None:
    """(x, y) = p_xy / p_z + U(-scale, scale)^2, then back to a unit vector on the same side."""
    scale, frame = 0.02, paper_frame(np.array(axis))
    b, true = bearings({"model": "paper", "scale": scale, "axis": list(axis)}, dtype="float64")
    assert_allclose(np.linalg.norm(b, axis=-1), 1.0, atol=1e-13)
    image, exact = b @ frame, true @ frame
    assert (np.sign(image[..., 2]) == np.sign(exact[:, 2])).all()
    off = (image[..., :2] / image[..., 2:] - exact[:, :2] / exact[:, 2:]) / scale
    assert np.abs(off).max() <= 1.0 + 1e-9
    for column in off.reshape(len(off), -1).T:
        assert stats.kstest(column, "uniform", args=(-1.0, 2.0)).pvalue > 1e-4
    assert np.abs(np.corrcoef(off.reshape(len(off), -1).T) - np.eye(off[0].size)).max() < 5 / np.sqrt(len(off))


def test_paper_noise_in_the_plane_of_the_axis_is_finite() -> None:
    """A target across the optical axis: the formula divides by zero there."""
    places = [(3.0, 0.0, 0.0), (0.0, -2.0, 0.0), (1.0, 1.0, 1e-9), (1.0, 2.0, -1e-9)]
    b, true = bearings(
        {"model": "paper", "scale": 0.005},
        20,
        10,
        "float64",
        landmarks=[landmark(f"L{j}", p) for j, p in enumerate(places)],
    )
    assert np.isfinite(b).all()
    assert_allclose(np.linalg.norm(b, axis=-1), 1.0, atol=1e-6)
    assert_allclose(b, np.broadcast_to(true, b.shape), atol=1e-4)


def test_misses_and_their_frequency() -> None:
    made = scenario([vehicle((0, 0, 0))], camera={"miss_probability": 0.3})
    states = run(start(made, range(100)), 99, "sight")
    missed = np.array([s["sight"][:, 0, :4] for s in states]) == Sight.MISSED
    assert abs(missed.mean() - 0.3) < 4 * np.sqrt(0.21 / missed.size)
    assert np.abs(missed.mean(axis=(0, 1)) - 0.3).max() < 4 * np.sqrt(0.21 / 10000)
    flat = missed.reshape(-1, 4).astype(float)
    assert np.abs(np.corrcoef(flat.T) - np.eye(4)).max() < 0.05
    later = np.corrcoef(missed[:-1].ravel(), missed[1:].ravel())[0, 1]
    assert abs(later) < 0.03


def test_a_missed_detection_keeps_the_last_bearing_and_its_tick() -> None:
    made = scenario([vehicle((0, 0, 0))], camera={"miss_probability": 0.5}, noise={"bearing": {"scale": 0.01}})
    states = run(start(made), 60)
    for before, now in pairwise(states):
        for j in range(4):
            tick = int(now["tick"][0])
            if now["sight"][0, 0, j] == Sight.VISIBLE:
                assert now["bearing_tick"][0, 0, j] == tick
                assert not np.array_equal(now["bearing"][0, 0, j], before["bearing"][0, 0, j])
            else:
                assert now["sight"][0, 0, j] == Sight.MISSED
                assert now["bearing_tick"][0, 0, j] == before["bearing_tick"][0, 0, j]
                assert np.array_equal(now["bearing"][0, 0, j], before["bearing"][0, 0, j])


@pytest.mark.parametrize(
    ("rate", "stated", "factor"),
    [(30.0, 60.0, np.sqrt(0.5)), (60.0, 60.0, 1.0), (240.0, 60.0, 2.0), (240.0, "sample", 1.0)],
)
def test_bearing_noise_keeps_its_density(rate: float, stated: float | str, factor: float) -> None:
    b, true = bearings({"scale": 0.004, "rate": stated}, rates={"camera": rate})
    turn = np.linalg.norm(np.cross(b, true), axis=-1)
    assert_allclose(np.sqrt((turn**2).mean() / 2), 0.004 * factor, rtol=0.02)


def test_noise_disabled_is_exact() -> None:
    made = scenario(
        [vehicle((0, 0, 0))],
        noise={"enabled": False, "velocity": 1.0, "angular_velocity": 1.0, "bearing": {"scale": 0.1}},
    )
    state = run(start(made), 3)[-1]
    place = np.array([p.position for p in made.landmarks])
    assert_allclose(state["bearing"][0, 0, :4], place / np.linalg.norm(place, axis=1, keepdims=True), atol=1e-14)
    assert (state["odometry_velocity"] == 0).all()
    assert (state["odometry_angular_velocity"] == 0).all()
