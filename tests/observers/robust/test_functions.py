"""Functions of the embedded observer `robust` against SciPy and NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.observers.robust.algebra import inverse6, is_regular, left_error, log_so3, transition
from coopenv.observers.robust.memory import Pose, mat33d, mat66d, vec3d, vec6d
from coopenv.world.launch import start_warp

start_warp()


@wp.kernel(enable_backward=False, module_options={"max_unroll": 1}, module="unique")
def algebra_kernel(
    R: wp.array(dtype=mat33d),
    p: wp.array(dtype=vec3d),
    A: wp.array(dtype=mat66d),
    w: wp.array(dtype=vec3d),
    e: wp.array(dtype=vec6d),
    F: wp.array(dtype=mat66d),
    inverse: wp.array(dtype=mat66d),
    regular: wp.array(dtype=wp.bool),
):
    n = wp.tid()
    w[n] = log_so3(R[n])
    e[n] = left_error(Pose(R[n], p[n]), Pose(R[0], p[0]))
    F[n] = transition(Pose(R[n], p[n]))
    inverse[n] = inverse6(A[n])
    regular[n] = is_regular(A[n], inverse[n], wp.float64(1.0e6))


def array(values: np.ndarray, dtype: Any) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")


@pytest.fixture(scope="module")
def algebra() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    turns = rng.normal(size=(200, 3))
    turns *= (rng.uniform(0, np.pi, 200) / np.linalg.norm(turns, axis=1))[:, None]
    turns[:3] *= np.array([1e-12, 1e-7, 0.0])[:, None] / np.maximum(np.linalg.norm(turns[:3], axis=1), 1e-3)[:, None]
    turns[3:20] *= ((np.pi - np.geomspace(1e-9, 0.3, 17)) / np.linalg.norm(turns[3:20], axis=1))[:, None]
    U = np.linalg.qr(rng.normal(size=(200, 6, 6)))[0]
    spectrum = 10.0 ** rng.uniform(-4, 4, (200, 6))
    given = {
        "R": Rotation.from_rotvec(turns).as_matrix(),
        "p": rng.normal(size=(200, 3)),
        "A": U * spectrum[:, None] @ np.swapaxes(U, 1, 2),
    }
    shapes = {"w": vec3d, "e": vec6d, "F": mat66d, "inverse": mat66d, "regular": wp.bool}
    out = {name: wp.zeros(200, dtype=dtype, device="cpu") for name, dtype in shapes.items()}
    inputs = [array(given[name], dtype) for name, dtype in (("R", mat33d), ("p", vec3d), ("A", mat66d))]
    wp.launch(algebra_kernel, dim=200, inputs=[*inputs, *out.values()], device="cpu")
    return {**given, "turns": turns, **{name: value.numpy() for name, value in out.items()}}


def test_rotation_vectors(algebra: dict[str, np.ndarray]) -> None:
    assert_allclose(algebra["w"], algebra["turns"], rtol=0, atol=1e-9)
    assert_allclose(algebra["w"][20:], algebra["turns"][20:], rtol=0, atol=1e-13)


def test_left_errors(algebra: dict[str, np.ndarray]) -> None:
    R, p = algebra["R"], algebra["p"]
    Rt = np.swapaxes(R, 1, 2)
    expected = np.concatenate([Rotation.from_matrix(Rt @ R[0]).as_rotvec(), np.einsum("nij,nj->ni", Rt, p[0] - p)], 1)
    assert_allclose(algebra["e"], expected, rtol=0, atol=1e-9)


def test_the_transition_is_the_derivative_of_the_error(algebra: dict[str, np.ndarray]) -> None:
    """Moving a pose and its neighbour by the same odometry turns a small left error x into F x."""
    x = 1e-6 * np.random.default_rng(8).normal(size=6)
    for dR, dp, F in zip(algebra["R"][30:60], algebra["p"][30:60], algebra["F"][30:60], strict=True):
        moved = Rotation.from_rotvec(x[:3]).as_matrix()
        theta = Rotation.from_matrix(dR.T @ moved @ dR).as_rotvec()
        rho = dR.T @ (x[3:] + moved @ dp - dp)
        assert_allclose(F @ x, np.concatenate([theta, rho]), rtol=0, atol=1e-11)


def test_inverses(algebra: dict[str, np.ndarray]) -> None:
    for A, inverse in zip(algebra["A"], algebra["inverse"], strict=True):
        assert_allclose(inverse @ A, np.eye(6), rtol=0, atol=1e-13 * np.linalg.cond(A))


def test_regularity_is_that_of_the_spectrum(algebra: dict[str, np.ndarray]) -> None:
    spectrum = np.linalg.eigvalsh(algebra["A"])
    condition = spectrum.sum(axis=1) * (1.0 / spectrum).sum(axis=1)
    clear = np.abs(np.log(condition / 1e6)) > 1e-3
    assert (algebra["regular"] == (condition < 1e6))[clear].all()
    assert 0 < algebra["regular"].sum() < 200 and clear.sum() > 190
