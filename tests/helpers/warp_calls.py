"""Call Warp functions on NumPy arrays, in either precision: one small kernel each, over the leading axis."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from coopenv.estimation import linalg, so3
from coopenv.observers.riccati import equations as riccati
from coopenv.world import camera, collision, quality, random
from coopenv.world.precision import Precision, precision

DTYPES = ("float64", "float32")
EPSILON = {"float64": np.finfo(np.float64).eps, "float32": np.finfo(np.float32).eps}


def _rotations(p: Precision, module: wp.Module) -> dict[str, Any]:
    scalar, vec3, mat33 = p.scalar, p.vec3, p.mat33

    @wp.kernel(module=module)
    def exp_so3(w: wp.array(dtype=vec3), out: wp.array(dtype=mat33)):
        i = wp.tid()
        out[i] = so3.exp_so3(w[i])

    @wp.kernel(module=module)
    def left_jacobian(w: wp.array(dtype=vec3), out: wp.array(dtype=mat33)):
        i = wp.tid()
        out[i] = so3.left_jacobian(w[i])

    @wp.kernel(module=module)
    def orthonormalise(R: wp.array(dtype=mat33), out: wp.array(dtype=mat33)):
        i = wp.tid()
        out[i] = so3.orthonormalise(R[i])

    @wp.kernel(module=module)
    def rotation_angle(R: wp.array(dtype=mat33), out: wp.array(dtype=scalar)):
        i = wp.tid()
        out[i] = so3.rotation_angle(R[i], vec3())

    @wp.kernel(module=module)
    def quaternion_vector(R: wp.array(dtype=mat33), out: wp.array(dtype=vec3)):
        i = wp.tid()
        out[i] = so3.quaternion_vector(R[i], vec3())

    return locals()


def _matrices(p: Precision, module: wp.Module) -> dict[str, Any]:
    scalar, vec3, mat33, mat66 = p.scalar, p.vec3, p.mat33, p.mat66

    @wp.kernel(module=module)
    def cholesky6(M: wp.array(dtype=mat66), out: wp.array(dtype=mat66), inverses: wp.array(dtype=mat66)):
        i = wp.tid()
        o = mat33()
        A = linalg.block3(M[i], 0, 0, o)
        L11, L21, L22, I11, I22 = linalg.cholesky6(A, linalg.block3(M[i], 0, 3, o), linalg.block3(M[i], 3, 3, o))
        out[i] = linalg.join6(L11, o, L21, L22, mat66())
        inverses[i] = linalg.join6(I11, o, o, I22, mat66())

    @wp.kernel(module=module)
    def eigen_symmetric6(M: wp.array(dtype=mat66), D: wp.array(dtype=mat66), U: wp.array(dtype=mat66)):
        i = wp.tid()
        identity = wp.identity(n=6, dtype=scalar)
        d, u = linalg.eigen_symmetric6(M[i], identity)
        D[i] = d
        U[i] = u

    @wp.kernel(module=module)
    def smallest_eigenvalue6(M: wp.array(dtype=mat66), out: wp.array(dtype=scalar)):
        i = wp.tid()
        out[i] = linalg.smallest_eigenvalue6(M[i])

    @wp.kernel(module=module)
    def log_determinant(P: wp.array(dtype=mat66), out: wp.array(dtype=scalar)):
        i = wp.tid()
        I11, _L21, I22 = quality.cholesky_of(P[i], mat33())
        out[i] = quality.log_determinant(I11, I22)

    @wp.kernel(module=module)
    def nees(
        P: wp.array(dtype=mat66),
        R: wp.array(dtype=mat33),
        position: wp.array(dtype=vec3),
        R_hat: wp.array(dtype=mat33),
        p_hat: wp.array(dtype=vec3),
        e1: wp.array(dtype=vec3),
        e2: wp.array(dtype=vec3),
        out: wp.array(dtype=scalar),
    ):
        i = wp.tid()
        I11, L21, I22 = quality.cholesky_of(P[i], mat33())
        a, b = quality.observer_error(R[i], position[i], R_hat[i], p_hat[i])
        e1[i] = a
        e2[i] = b
        out[i] = quality.normalised_error_squared(I11, L21, I22, a, b)

    return locals()


def _observer(p: Precision, module: wp.Module) -> dict[str, Any]:
    scalar, vec2, vec3, mat33, mat66 = p.scalar, p.vec2, p.vec3, p.mat33, p.mat66

    @wp.kernel(module=module)
    def gain_factor(
        k: wp.array(dtype=scalar),
        m: wp.array(dtype=scalar),
        h: wp.array(dtype=scalar),
        out: wp.array(dtype=scalar),
    ):
        i = wp.tid()
        out[i] = riccati.gain_factor(k[i], m[i], h[i])

    @wp.kernel(module=module)
    def predict_covariance(
        E: wp.array(dtype=mat33), P: wp.array(dtype=mat66), v: wp.array(dtype=vec2), out: wp.array(dtype=mat66)
    ):
        i = wp.tid()
        o = mat33()
        A = linalg.block3(P[i], 0, 0, o)
        B = linalg.block3(P[i], 0, 3, o)
        D = linalg.block3(P[i], 3, 3, o)
        A, B, D = riccati.predict_covariance(E[i], A, B, D, v[i][0], v[i][1])
        out[i] = linalg.join6(A, B, wp.transpose(B), D, mat66())

    @wp.kernel(module=module)
    def information(
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        e: wp.array(dtype=vec3),
        q: wp.array(dtype=scalar),
        M: wp.array(dtype=mat66),
        r1: wp.array(dtype=vec3),
        r2: wp.array(dtype=vec3),
    ):
        i = wp.tid()
        M11, M12, M22, s1, s2 = riccati.accumulate_information(
            a[i], b[i], e[i], q[i], mat33(), mat33(), mat33(), vec3(), vec3()
        )
        M[i] = linalg.join6(M11, M12, wp.transpose(M12), M22, mat66())
        r1[i] = s1
        r2[i] = s2

    @wp.kernel(module=module)
    def correct(
        k: wp.array(dtype=scalar),
        h: wp.array(dtype=scalar),
        P: wp.array(dtype=mat66),
        M: wp.array(dtype=mat66),
        r1: wp.array(dtype=vec3),
        r2: wp.array(dtype=vec3),
        dx1: wp.array(dtype=vec3),
        dx2: wp.array(dtype=vec3),
        out: wp.array(dtype=mat66),
    ):
        i = wp.tid()
        o = mat33()
        M11 = linalg.block3(M[i], 0, 0, o)
        M12 = linalg.block3(M[i], 0, 3, o)
        M22 = linalg.block3(M[i], 3, 3, o)
        L11, L21, L22, _I11, _I22 = linalg.cholesky6(
            linalg.block3(P[i], 0, 0, o), linalg.block3(P[i], 0, 3, o), linalg.block3(P[i], 3, 3, o)
        )
        if k[i] == scalar(1.0):
            a, b, A, B, D = riccati.correct_kalman(h[i], M11, M12, M22, L11, L21, L22, r1[i], r2[i])
            dx1[i] = a
            dx2[i] = b
            out[i] = linalg.join6(A, B, wp.transpose(B), D, mat66())
        else:
            identity = wp.identity(n=6, dtype=scalar)
            T, m = riccati.correction_modes(M11, M12, M22, L11, L21, L22, mat66(), identity)
            a, b = riccati.correct_modes(k[i], h[i], T, m, r1[i], r2[i])
            dx1[i] = a
            dx2[i] = b
            out[i] = riccati.covariance_modes(h[i], T, m)

    return locals()


def _numbers(p: Precision, module: wp.Module) -> dict[str, Any]:
    scalar, vec3 = p.scalar, p.vec3

    @wp.kernel(module=module)
    def philox(
        counter: wp.array2d(dtype=wp.uint32), key: wp.array2d(dtype=wp.uint32), out: wp.array2d(dtype=wp.uint32)
    ):
        i = wp.tid()
        c = random.vec4u(counter[i, 0], counter[i, 1], counter[i, 2], counter[i, 3])
        words = random.philox(c, key[i, 0], key[i, 1])
        for j in range(4):
            out[i, j] = words[j]

    @wp.kernel(module=module)
    def draw(
        seed: wp.array(dtype=wp.uint64),
        episode: wp.array(dtype=wp.uint32),
        index: wp.array(dtype=wp.int32),
        subject: wp.array(dtype=wp.int32),
        stream: wp.array(dtype=wp.uint32),
        out: wp.array2d(dtype=wp.uint32),
    ):
        i = wp.tid()
        words = random.draw(seed[i], episode[i], index[i], subject[i], stream[i])
        for j in range(4):
            out[i, j] = words[j]

    @wp.kernel(module=module)
    def uniform(word: wp.array(dtype=wp.uint32), out: wp.array(dtype=scalar)):
        i = wp.tid()
        out[i] = random.uniform(word[i], scalar(1.0))

    @wp.kernel(module=module)
    def gaussian_pair(words: wp.array2d(dtype=wp.uint32), out: wp.array2d(dtype=scalar)):
        i = wp.tid()
        x, y = random.gaussian_pair(words[i, 0], words[i, 1], scalar(1.0))
        out[i, 0] = x
        out[i, 1] = y

    @wp.kernel(module=module)
    def unit_vector(words: wp.array2d(dtype=wp.uint32), out: wp.array(dtype=vec3)):
        i = wp.tid()
        out[i] = random.unit_vector(words[i, 0], words[i, 1], vec3())

    return locals()


def _geometry(p: Precision, module: wp.Module) -> dict[str, Any]:
    scalar, vec2, vec3, mat33 = p.scalar, p.vec2, p.vec3, p.mat33

    @wp.struct
    class Lens:
        k1: scalar
        k2: scalar
        p1: scalar
        p2: scalar
        k3: scalar

    @wp.kernel(module=module)
    def distort(
        lens: wp.array2d(dtype=scalar),
        xy: wp.array(dtype=vec2),
        out: wp.array(dtype=vec2),
        back: wp.array(dtype=vec2),
    ):
        i = wp.tid()
        s = Lens()
        s.k1 = lens[i, 0]
        s.k2 = lens[i, 1]
        s.p1 = lens[i, 2]
        s.p2 = lens[i, 3]
        s.k3 = lens[i, 4]
        x, y = camera.distort(s, xy[i][0], xy[i][1])
        out[i] = vec2(x, y)
        x, y = camera.undistort(s, x, y)
        back[i] = vec2(x, y)

    @wp.kernel(module=module)
    def segment_hits_box(
        start: wp.array(dtype=vec3),
        end: wp.array(dtype=vec3),
        R: wp.array(dtype=mat33),
        center: wp.array(dtype=vec3),
        half: wp.array(dtype=vec3),
        out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        d = end[i] - start[i]
        out[i] = int(camera.segment_hits_box(start[i], d, d.dtype(1.0) / wp.dot(d, d), R[i], center[i], half[i]))

    @wp.kernel(module=module)
    def boxes_touch(
        ca: wp.array(dtype=vec3),
        Ra: wp.array(dtype=mat33),
        ha: wp.array(dtype=vec3),
        cb: wp.array(dtype=vec3),
        Rb: wp.array(dtype=mat33),
        hb: wp.array(dtype=vec3),
        out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        out[i] = int(collision.boxes_touch(ca[i], Ra[i], ha[i], cb[i], Rb[i], hb[i]))

    return locals()


@cache
def _kernels(dtype: str) -> dict[str, wp.Kernel]:
    found: dict[str, Any] = {}
    for group in (_rotations, _matrices, _observer, _numbers, _geometry):
        module = wp.get_module(f"tests.helpers.warp_calls{group.__name__}.{dtype}")
        module.options["enable_backward"] = False
        found |= group(precision(dtype), module)
    return {name: value for name, value in found.items() if isinstance(value, wp.Kernel)}


def call(name: str, dtype: str, *inputs: ArrayLike) -> Any:
    """Launch one kernel over the first axis of its inputs and return its outputs, floats as float64.

    Inputs that do not fit the first one's length are repeated. Arguments beyond the inputs are outputs.
    """
    kernel = _kernels(dtype)[name]
    types = [argument.type for argument in kernel.adj.args]
    count = max(np.shape(value)[0] for value in inputs)
    sources = []
    for value, array in zip(inputs, types, strict=False):
        number = wp.dtype_to_numpy(getattr(array.dtype, "_wp_scalar_type_", array.dtype))
        data = np.ascontiguousarray(np.broadcast_to(value, (count, *np.shape(value)[1:])), dtype=number)
        sources.append(wp.array(data, dtype=array.dtype, ndim=array.ndim, device="cpu"))
    results = [wp.zeros((count, 4)[: array.ndim], dtype=array.dtype, device="cpu") for array in types[len(inputs) :]]
    wp.launch(kernel, dim=count, inputs=sources, outputs=results, device="cpu")
    arrays = [r.numpy().astype(float) if r.dtype != wp.uint32 else r.numpy() for r in results]
    return arrays[0] if len(arrays) == 1 else tuple(arrays)
