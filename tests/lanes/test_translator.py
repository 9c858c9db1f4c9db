"""A kernel in lanes computes what Warp's own kernel does, world by world, and leaves out what it has not to take."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from coopenv.lanes import translator
from coopenv.lanes.translator import in_lanes, lanes_option
from coopenv.world.launch import launch, module_kernels, width_of_lanes
from coopenv.world.model import precision

WORLDS = 21
"""Two steps of eight worlds, and five worlds that remain."""
FLOATS, NUMBERS, VECTORS = 24, 16, 4
"""Results of a world."""
pytestmark = pytest.mark.skipif(not width_of_lanes("cpu", "float32"), reason="a processor without AVX2")


def ours(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose indices Warp writes as for this package's functions."""
    function.__module__ = "coopenv.samples"
    return function


@wp.func
@ours
def floats_of(out: wp.array2d(dtype=wp.float32), world: int, x: float, y: float):
    """Write functions of one and two numbers."""
    size = wp.abs(x) + 0.01
    unit = wp.clamp(x, -1.0, 1.0)
    out[world, 0] = wp.sin(x)
    out[world, 1] = wp.cos(y)
    out[world, 2] = wp.log(size)
    out[world, 3] = wp.exp(unit)
    out[world, 4] = wp.tan(unit)
    out[world, 5] = wp.atan(x)
    out[world, 6] = wp.atan2(x, y)
    out[world, 7] = wp.asin(unit) + wp.acos(unit)
    out[world, 8] = wp.pow(size, y)
    out[world, 9] = wp.sqrt(size)
    out[world, 10] = wp.floor(x) + 100.0 * wp.ceil(y)
    out[world, 11] = wp.round(x)
    out[world, 12] = wp.sign(x) * wp.max(x, y) - wp.min(x, y)
    out[world, 13] = x / y - (-x)
    out[world, 14] = float(wp.float64(x) * wp.float64(y)) + float(int(x))
    out[world, 15] = wp.max(wp.log(x), wp.min(y, wp.log(x)))  # the logarithm of a negative number is no number
    out[world, 17] = wp.log(wp.max(x, 0.0)) + wp.log(size / (size - size))
    out[world, 18] = wp.sin(1000.0 * x) + wp.cos(1000.0 * y)
    out[world, 16] = wp.where(wp.isfinite(x / (y - y)), 1.0, 2.0)


@wp.func
@ours
def numbers_of(out: wp.array2d(dtype=wp.int32), world: int, i: int, j: int):
    """Write functions of whole numbers."""
    u = wp.uint32(i)
    v = wp.uint32(j)
    wide = wp.uint64(u) * wp.uint64(v)
    divisor = wp.where(j == 0, 1, j)
    out[world, 0] = i % divisor
    out[world, 1] = i // divisor
    out[world, 2] = i // 7 - i % 7
    out[world, 3] = int(u * v)
    out[world, 4] = int(wp.uint32(wide >> wp.uint64(32)))
    out[world, 5] = int((u ^ v) & (u | wp.uint32(255)))
    out[world, 6] = int((u >> wp.uint32(3)) + (v << wp.uint32(2)))
    out[world, 7] = wp.clamp(i, -5, 5) + wp.abs(wp.max(j, -10)) - wp.min(i, j)
    out[world, 8] = int(i < j) + 2 * int(i <= j) + 4 * int(i == j) + 8 * int(u > v) + 16 * int(i != j and not i > 3)


@wp.func
@ours
def found_early(x: float, count: int) -> int:
    """Return from inside of a loop, at another turn in each world."""
    total = x
    for n in range(count):
        if n == 2:
            continue
        total = total + 0.5
        if total > 3.0:
            return n
    return -1


@wp.func
@ours
def loops_of(out: wp.array2d(dtype=wp.int32), world: int, x: float, i: int):
    """Write results of loops and branches that differ between worlds."""
    out[world, 9] = found_early(x, i)
    turns = int(0)  # noqa: RUF046, UP018
    size = wp.abs(x) + 1.0
    while size > 0.1 and turns < 50:
        size = size * 0.5
        turns += 1
    out[world, 10] = turns
    total = int(0)  # noqa: RUF046, UP018
    for n in range(i, 6):
        if n > 4:
            break
        for m in range(3):
            if m > n:
                continue
            total += n * m
        out[world, 11] = n
    out[world, 12] = total
    if x > 0.0:
        if i > 2:
            out[world, 13] = 5
            total = 7
        else:
            total = total + 1
    elif i == 0:
        total = -total
    out[world, 14] = total


@wp.func
@ours
def vectors_of(given: wp.array2d(dtype=wp.mat33), out: wp.array2d(dtype=wp.vec3), world: int, x: float, i: int):
    """Write functions of vectors and matrices, with components and rows that differ between worlds."""
    A = given[world, i % 2]
    a = given[world, 0] * wp.vec3(x, 1.0, 2.0)
    b = wp.normalize(wp.cross(a, wp.vec3(0.0, 1.0, 0.0)))
    a[i % 3] = wp.dot(a, b)
    if x > 0.0:
        a[1] = a[2] + a[i % 3]
    B = wp.transpose(A) * A + wp.outer(a, b) - wp.diag(b)
    out[world, 0] = a
    out[world, i % 2 + 1] = B * a + wp.normalize(a - a)
    out[world, 3] = wp.vec3(wp.trace(B), wp.length(a), wp.length_sq(b))


@ours
def sample(
    x: wp.array2d(dtype=wp.float32),
    i: wp.array2d(dtype=wp.int32),
    A: wp.array2d(dtype=wp.mat33),
    hold: wp.array(dtype=wp.int32),
    floats: wp.array2d(dtype=wp.float32),
    numbers: wp.array2d(dtype=wp.int32),
    vectors: wp.array2d(dtype=wp.vec3),
):
    """Write everything in the worlds that are not held."""
    world = wp.tid()
    if hold[world] == 0:
        floats_of(floats, world, x[world, 0], x[world, 1])
        numbers_of(numbers, world, i[world, 0], i[world, 1])
        loops_of(numbers, world, x[world, 0], i[world, 2])
        vectors_of(A, vectors, world, x[world, 1], i[world, 2])


UNKNOWN = """
struct wp_args_k {{
    wp::array_t<wp::float32> x;
}};
static void k_1_cpu_kernel_forward(
    wp_args_k *_wp_args)
{{
    //---------
    // argument vars
    wp::array_t<wp::float32> var_x = _wp_args->x;
    //---------
    // primal vars
    wp::int32 var_0;
    wp::float32* var_1;
    wp::float32 var_2;
    wp::float32 var_3;
    //---------
    // forward
    var_0 = builtin_tid1d();
    var_1 = &coopenv::element(var_x, var_0);
    var_2 = wp::load(var_1);
    var_3 = {call}(var_2);
    coopenv::element(var_x, var_0) = var_3;
}}
for (size_t task_index = 0; task_index < dim->size; ++task_index) k_1_cpu_kernel_forward(_wp_args);
"""
"""A module with one kernel, as Warp writes it."""
STAGES = ("floats_of", "numbers_of", "loops_of", "vectors_of")


def inputs(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(WORLDS, 2)) * 10.0 ** rng.integers(-2, 3, (WORLDS, 2))
    i = np.column_stack([rng.integers(-(2**31), 2**31, (WORLDS, 2)), rng.integers(0, 6, WORLDS)])
    i[:4, :2] = [[-7, 3], [7, -3], [-(2**31), 2], [5, 0]]
    return [x.astype(np.float32), i.astype(np.int32), rng.normal(size=(WORLDS, 2, 3, 3)).astype(np.float32)]


def results(kernel: wp.Kernel, hold: np.ndarray) -> list[np.ndarray]:
    """Return what a kernel writes into arrays of fours."""
    x, i, A = inputs()
    given = [wp.array(x), wp.array(i), wp.array(A, dtype=wp.mat33), wp.array(hold, dtype=wp.int32)]
    shapes = [((WORLDS, FLOATS), wp.float32), ((WORLDS, NUMBERS), wp.int32), ((WORLDS, VECTORS), wp.vec3)]
    out = [wp.full(shape, 4, dtype=kind, device="cpu") for shape, kind in shapes]
    launch(kernel, dim=WORLDS, inputs=[*given, *out], device="cpu", block_dim=1)
    return [array.numpy() for array in out]


def kernel(name: str, **options: Any) -> wp.Kernel:
    return module_kernels(f"tests.{name}", precision("float32"), sample, **options)["sample"]


@pytest.mark.parametrize("held", ["no world", "some worlds", "seven of eight worlds"])
def test_lanes_equal_warps_own_kernel(held: str) -> None:
    hold = {"no world": [0], "some worlds": [0, 1, 1, 0, 0], "seven of eight worlds": [1, 1, 1, 0, 1, 1, 1, 1]}[held]
    masked = np.resize(hold, WORLDS)
    floats, numbers, vectors = results(kernel("one_world"), masked)
    own = kernel("lanes", in_lanes=lanes_option("sample", STAGES, grid=True))
    found = results(own, masked)
    assert (numbers[masked == 0, :9] != 4).any(axis=0).all() and (numbers[masked == 1] == 4).all()
    np.testing.assert_array_equal(found[1], numbers)
    np.testing.assert_allclose(found[0], floats, rtol=3e-6, atol=1e-6)
    np.testing.assert_allclose(found[2], vectors, rtol=2e-5, atol=1e-5)


def test_a_changed_translator_or_header_makes_another_module(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Warp finds a compiled module by a hash of its options, among others."""
    modules = [kernel("hash", in_lanes=lanes_option("sample", STAGES, grid=True)).module.get_module_hash()]
    for name in ("lanes.h", "translator.py"):
        shutil.copytree(translator.HEADER.parent, tmp_path / name)
        with (tmp_path / name / name).open("a") as file:
            file.write("// changed")
        monkeypatch.setattr(translator, "HEADER", tmp_path / name / "lanes.h")
        modules.append(
            kernel(f"hash_{name}", in_lanes=lanes_option("sample", STAGES, grid=True)).module.get_module_hash()
        )
    assert len(set(modules)) == 3


def test_an_unknown_construct_leaves_the_kernel_as_it_is() -> None:
    """In the kernel itself; a function with one is called world by world."""
    text = UNKNOWN.format(call="wp::tile_sum")
    assert in_lanes(text, lanes_option("k", ["f"], grid=True)) == text
    assert "wp::World" in in_lanes(UNKNOWN.format(call="wp::sqrt"), lanes_option("k", ["f"], grid=True))
