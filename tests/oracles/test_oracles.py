"""The oracles against the paper's figures, published known answers, and a second computation.

`splitting` is compared with the kernels and with `continuous` in `tests/observers/riccati`.
"""

from __future__ import annotations

import numpy as np
import pytest

from . import continuous, geometry

SETTLE = (2.95, 7.90, 10.55, 11.65, 29.9)  # s, f1 .. f5
PIXY = {"fx": 213.161906, "fy": 213.521038, "cx": 154.841998, "cy": 114.98398, "width": 316, "height": 208}
PLUMB_BOB = (-0.352043, 0.137879, 0.001953, 0.000628, 0.0)


@pytest.fixture(scope="module")
def busy() -> continuous.Result:
    return continuous.solve(continuous.busy_intersection(), 50.0)


def test_continuous_settle_times(busy: continuous.Result) -> None:
    np.testing.assert_allclose(busy.settle_times(), SETTLE, atol=0.051)
    assert np.linalg.norm(busy.position_error[-1], axis=-1).max() < 1e-6


def test_continuous_keeps_rotations_and_symmetry(busy: continuous.Result) -> None:
    gram = np.swapaxes(busy.R_hat, -1, -2) @ busy.R_hat
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-6)
    np.testing.assert_allclose(busy.P, np.swapaxes(busy.P, -1, -2), atol=1e-9)
    assert np.linalg.eigvalsh(busy.P).min() > 0.0


def test_transposed_start_falls_into_the_mirror() -> None:
    result = continuous.solve(continuous.busy_intersection(mirror=True), 50.0)
    assert (result.angle_error_deg[-1] > 170.0).all()
    assert np.isnan(result.settle_times()).all()


def test_true_pose_is_an_equilibrium() -> None:
    case = continuous.small_error_case(lever_arm=(0.3, 0.0, 0.2), angle=0.0, offset=0.0)
    result = continuous.solve(case, 2.0)
    assert np.abs(result.position_error).max() < 1e-7
    assert result.angle_error_deg.max() < 1e-5


def test_pose_obeys_the_kinematics() -> None:
    case = continuous.small_error_case()
    t, step = 1.7, 1e-5
    (R0, x0), (R, _), (R1, x1) = (case.pose(s) for s in (t - step, t, t + step))
    np.testing.assert_allclose((R1 - R0) / (2 * step), R @ continuous.skew(case.angular_velocity), atol=1e-8)
    np.testing.assert_allclose((x1 - x0) / (2 * step), (R @ case.velocity[..., None])[..., 0], atol=1e-8)


def test_field_of_view_angles() -> None:
    right, up = np.radians(36.0), np.radians(27.0)
    ray = [
        [np.sin(right), 0, np.cos(right)],
        [-np.sin(right), 0, np.cos(right)],
        [0, -np.sin(up), np.cos(up)],
    ]
    assert geometry.in_field_of_view(ray, **PIXY).tolist() == [True, False, True]
    assert not geometry.in_field_of_view([0.0, 0.0, -1.0], **PIXY)


def test_camera_axes() -> None:
    R = continuous.exponential([0.0, 0.0, np.pi / 2])  # heading north
    seen = geometry.point_in_camera([0.1, 2.0, 0.5], R, [0.0, 0.0, 0.0], (0.3, 0.0, 0.2))
    np.testing.assert_allclose(seen, [0.1, -0.3, 1.7], atol=1e-12)


def test_distortion() -> None:
    # by hand at (0.5, 0): r2 = 0.25, radial = 0.9206066875
    np.testing.assert_allclose(
        geometry.distort_plumb_bob([0.5, 0.0], PLUMB_BOB),
        [0.5 * 0.9206066875 + 0.000628 * 0.75, 0.001953 * 0.25],
        atol=1e-12,
    )


def test_occlusion_by_sampling() -> None:
    rng = np.random.default_rng(2)
    depths = []
    for _ in range(100):
        start, end, centre = rng.uniform(-2.0, 2.0, (3, 3))
        box = (centre, continuous.exponential(rng.normal(size=3)), rng.uniform(0.3, 1.5, 3))
        depth = geometry.depth_by_enumeration(start, end, *box)
        points = start + np.linspace(0.0, 1.0, 4001)[:, None] * (end - start)
        sampled = (box[2] - np.abs((points - centre) @ box[1])).min(axis=-1).max()
        assert sampled <= depth + 1e-12
        assert depth - sampled < 2e-3
        depths.append(depth)
    assert 0.1 < np.mean(np.array(depths) > 0.0) < 0.9
