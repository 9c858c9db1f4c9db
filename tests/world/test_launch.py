"""Devices, functions that are handed records by reference, and the cache of compiled kernels."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import coopenv
from coopenv.api.vector_env import INFO_FIELDS
from coopenv.sources.worlds import Simulated
from coopenv.world import launch, state
from coopenv.world import world as batches
from coopenv.world.launch import start_warp
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.processes import COOPENV, ROOT, small_disk

start_warp()
CUDA = pytest.param("cuda:0", marks=pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device"))
OVERRIDES: dict[str, Any] = {"horizon": 3.0}


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("name", ["busy_intersection", FOUR_WAY])
def test_worlds_agree_with_the_cpu(name: str, device: str) -> None:
    scenario = coopenv.load_scenario(name, OVERRIDES)
    worlds = [Simulated(scenario).world(5, "float64", where, None) for where in ("cpu", device)]
    actions = np.random.default_rng(0).uniform(-1, 1, (5, len(scenario.vehicles), 2))
    for world in worlds:
        world.reset(range(5))
        world.actions.assign(actions)
        for _ in range(10):
            world.advance(scenario.ticks_per_decision)
    here, there = (world.get_state() for world in worlds)
    for name_of, value in here.items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(there[name_of], value, rtol=1e-7, atol=1e-8, err_msg=name_of)
        else:
            np.testing.assert_array_equal(there[name_of], value, err_msg=name_of)


def as_on_a_gpu(patch: pytest.MonkeyPatch) -> None:
    """Let worlds on the CPU lie in memory as those on a GPU do."""
    for module in (state, batches):
        patch.setattr(module, "interleaves_worlds", lambda device: True)


@pytest.mark.parametrize("observer", ["riccati", "robust"])
def test_neither_layout_nor_levels_change_anything(observer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = coopenv.load_scenario("busy_intersection", {**OVERRIDES, "observer.name": observer})
    found = []
    for is_gpu in (False, True):
        if is_gpu:
            as_on_a_gpu(monkeypatch)
            monkeypatch.setattr(batches, "threads_and_lanes", lambda *given: (1, 2 if observer == "robust" else 1))
        batch = Simulated(scenario).world(5, "float64", "cpu", None)
        if is_gpu and observer == "robust":
            batch._levels = [batch._turns_of_level(level) for level in range(len(scenario.vehicles))]
        batch.reset(range(5))
        for _ in range(10):
            batch.advance(scenario.ticks_per_decision)
        found.append(batch.get_state())
    for name, value in found[0].items():
        if value.dtype.kind == "f":
            np.testing.assert_allclose(found[1][name], value, rtol=1e-7, atol=1e-8, err_msg=name)
        else:
            np.testing.assert_array_equal(found[1][name], value, err_msg=name)


def test_infos_of_interleaved_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="needs the extra 'train'")
    plain = coopenv.make_vec(FOUR_WAY, num_worlds=3)
    as_on_a_gpu(monkeypatch)
    tensors = coopenv.make_vec(FOUR_WAY, num_worlds=3, arrays="torch")
    plain.reset(seed=1)
    tensors.reset(seed=1)
    for _ in range(5):
        expected, found = (batch.step(np.zeros((12, 2), np.float32))[4] for batch in (plain, tensors))
    for name in INFO_FIELDS:
        np.testing.assert_allclose(found[name].numpy(), expected[name], atol=1e-4, err_msg=name)


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_tensors_share_memory_and_agree_with_numpy(device: str, autoreset: str) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra 'train'")
    options: dict[str, Any] = {"num_worlds": 4, "autoreset": autoreset, "overrides": OVERRIDES}
    tensors = coopenv.make_vec(FOUR_WAY, device=device, arrays="torch", **options)
    arrays = coopenv.make_vec(FOUR_WAY, **options)
    seen, _ = tensors.reset(seed=3)
    assert str(seen.device) == device and seen.dtype == torch.float32
    np.testing.assert_allclose(seen.cpu().numpy(), arrays.reset(seed=3)[0], atol=1e-4)
    rng = np.random.default_rng(0)
    for _ in range(40):
        actions = rng.uniform(-1, 1, (16, 2)).astype(np.float32)
        given = tensors.step(torch.as_tensor(actions, device=device))
        expected = arrays.step(actions)
        assert given[0].data_ptr() == seen.data_ptr()
        assert given[2].cpu().numpy().tolist() == expected[2].tolist()
        assert given[3].cpu().numpy().tolist() == expected[3].tolist()
        np.testing.assert_allclose(given[0].cpu().numpy(), expected[0], atol=2e-3)
        np.testing.assert_allclose(given[1].cpu().numpy(), expected[1], atol=2e-3)


@pytest.mark.parametrize("flags", [None, "", "-march=native -O0"])
def test_flags_of_the_user_stay(monkeypatch: pytest.MonkeyPatch, flags: str | None) -> None:
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", flags)
    assert launch.compiler_options() == {}


PACKAGE = Path(coopenv.__file__).parent
OWN = PACKAGE / "world" / "warp_internals.py"
PRIVATE = re.compile(
    r"warp\._|_wp_scalar_type_|\b_src\b|\.(_cls|native_func|hooks|get_module_hash|user_modules|inline_hint)\b"
)


def test_no_other_file_uses_the_private_interface_of_warp() -> None:
    users = {path for path in PACKAGE.rglob("*.py") if PRIVATE.search(path.read_text(encoding="utf-8"))}
    assert users == {OWN}


PROGRAM = """
import sys
from typing import Any
import numpy as np
import warp as wp
from coopenv.base.errors import CoopenvError
from coopenv.world.launch import Launcher, start_warp

def twice(x: wp.array(dtype=Any)):
    i = wp.tid()
    x[i] = x[i] + x[i]

try:
    start_warp()
    x = wp.array(np.arange(3.0), dtype=wp.float64, device="cpu")
    Launcher(3, "cpu", "float64")("twice", twice, [x])
    print(x.numpy().tolist())
except CoopenvError as error:
    print("error:", error)
"""
DONE = "[0.0, 2.0, 4.0]\n"
"""Output of the program."""


def double(x: wp.array(dtype=Any)):
    i = wp.tid()
    x[i] = x[i] + x[i]


def double_from_behind(x: wp.array(dtype=Any)):
    for k in range(x.shape[0], 0, -1):
        x[k - 4] = x[k - 4] + x[k - 4]


def test_kernels_of_users_count_from_the_end() -> None:
    """Only those of this package do without."""
    x = wp.array(np.arange(3.0), dtype=wp.float64, device="cpu")
    launch.launch(launch.kernel(double_from_behind, "float64"), dim=1, inputs=[x], device="cpu")
    assert x.numpy().tolist() == [0.0, 2.0, 4.0]


@pytest.fixture
def doubled(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], list[float]]:
    """A function that launches a kernel with a cache, as if this process had loaded nothing yet."""
    launch.start_warp()
    kernel = launch.kernel(double, "float64")

    def run(cache: Path) -> list[float]:
        monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cache))
        kernel.module.unload()
        launch._loaded.discard(kernel.module.name)
        x = wp.array(np.arange(3.0), dtype=wp.float64, device="cpu")
        launch.Launcher(3, "cpu", "float64")("double", double, [x])
        return list(x.numpy())

    return run


@pytest.fixture
def program(tmp_path: Path) -> Path:
    (tmp_path / "program.py").write_text(PROGRAM)
    return tmp_path / "program.py"


def run(*command: str | Path, **variables: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **{name: str(value) for name, value in variables.items()}}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_damaged_modules_are_built_again(doubled: Callable[[Path], list[float]], tmp_path: Path) -> None:
    assert doubled(tmp_path) == [0.0, 2.0, 4.0]
    for suffix, left in ((".o", 0.5), (".o", 0.0), (".meta", 0.5)):
        (part,) = tmp_path.glob(f"wp_*double*/*{suffix}")
        good = part.read_bytes()
        part.write_bytes(good[: int(left * len(good))])
        assert doubled(tmp_path) == [0.0, 2.0, 4.0]
        assert len(part.read_bytes()) == len(good)


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of files")
def test_one_of_many_processes_compiles(program: Path, tmp_path: Path) -> None:
    loud = "    start_warp()\n    wp.config.log_level = wp.LOG_INFO\n"
    program.write_text(PROGRAM.replace("    start_warp()\n", loud))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(tmp_path / "cache")}
    command = [sys.executable, str(program)]
    started = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120)[0] for process in started]
    assert all(words.endswith(DONE) for words in said)
    loaded = [next(line for line in words.splitlines() if "twice" in line) for words in said]
    assert sorted("(compiled)" in line for line in loaded) == [False, True]


def test_a_place_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    place = "/proc/nowhere"
    command = (*COOPENV, "run", "overtaking", "--steps", "1", "--out", tmp_path / "result")
    done = run("env", "-u", "WARP_CACHE_PATH", "-u", "XDG_CACHE_HOME", *command, HOME=place)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"error: cannot keep compiled kernels in {place}/")
    assert "WARP_CACHE_PATH" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", "20m") as place:
        yield place


def test_a_read_only_cache_serves_what_it_has(doubled: Callable[[Path], list[float]], disk: Path) -> None:
    remount = ["mount", "-o", "remount,ro", disk]
    subprocess.run(remount, check=True)
    with pytest.raises(launch.KernelCacheError, match=f"cannot keep compiled kernels in {disk}: Read-only"):
        doubled(disk)
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    assert doubled(disk) == [0.0, 2.0, 4.0]
    subprocess.run(remount, check=True)
    assert doubled(disk) == [0.0, 2.0, 4.0]


def test_a_full_disk_is_reported_before_the_compiler_meets_it(program: Path, disk: Path) -> None:
    with (disk / "filler").open("wb", buffering=0) as stream:
        while stream.write(bytes(1 << 16)) == 1 << 16:
            if stream.tell() > 18 << 20:
                break
    done = run(sys.executable, program, WARP_CACHE_PATH=disk)
    assert "No space left on device; set the variable WARP_CACHE_PATH" in done.stdout
    assert done.stderr == ""


def test_modules_of_a_wheel_are_copied_and_not_compiled(tmp_path: Path) -> None:
    step = "e = coopenv.parallel_env('busy_intersection'); e.reset(seed=0); e.step({a: [0, 0] for a in e.agents})"
    exec(step, {"coopenv": coopenv})  # compiles them, at most
    begin = "import coopenv, pathlib, warp; from coopenv.world import launch; warp._src.build.build_cpu = None"
    code = f"{begin}; launch.SHIPPED = pathlib.Path({os.fspath(launch.cache_folder())!r}); {step}"
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len([*tmp_path.rglob("*.o")]) >= 2


def test_machine_code_is_taken_from_the_package_alone() -> None:
    assert Path(coopenv.__file__).parent / "data" / "kernels" == launch.SHIPPED
