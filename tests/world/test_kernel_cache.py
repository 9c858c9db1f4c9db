"""The cache of compiled kernels: damaged, read-only, full, or in no place that can be."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from coopenv.world import launch
from tests.helpers.processes import COOPENV, ROOT, small_disk

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
"""What the program prints."""


def double(x: wp.array(dtype=Any)):
    i = wp.tid()
    x[i] = x[i] + x[i]


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


def test_what_is_damaged_is_built_again(doubled: Callable[[Path], list[float]], tmp_path: Path) -> None:
    assert doubled(tmp_path) == [0.0, 2.0, 4.0]
    for suffix, left in ((".o", 0.5), (".o", 0.0), (".meta", 0.5)):
        (part,) = tmp_path.glob(f"wp_*double*/*{suffix}")
        good = part.read_bytes()
        part.write_bytes(good[: int(left * len(good))])
        assert doubled(tmp_path) == [0.0, 2.0, 4.0]
        assert len(part.read_bytes()) == len(good)


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of files")
def test_of_many_processes_one_compiles(program: Path, tmp_path: Path) -> None:
    loud = "    start_warp()\n    wp.config.log_level = wp.LOG_INFO\n"
    program.write_text(PROGRAM.replace("    start_warp()\n", loud))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "WARP_CACHE_PATH": str(tmp_path / "cache")}
    command = [sys.executable, str(program)]
    started = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120)[0] for process in started]
    assert all(words.endswith(DONE) for words in said)
    loaded = [next(line for line in words.splitlines() if "twice" in line) for words in said]
    assert sorted("(compiled)" in line for line in loaded) == [False, True]


@pytest.mark.parametrize(("variable", "place"), [("WARP_CACHE_PATH", "/dev/null"), ("HOME", "/proc/nowhere")])
def test_a_place_that_cannot_be_is_one_line(variable: str, place: str, tmp_path: Path) -> None:
    unset = [word for name in {"WARP_CACHE_PATH", "XDG_CACHE_HOME"} - {variable} for word in ("-u", name)]
    command = (*COOPENV, "run", "overtaking", "--steps", "1", "--out", tmp_path / "result")
    done = run("env", *unset, *command, **{variable: place})
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


def test_a_full_disk_is_told_before_the_compiler_meets_it(program: Path, disk: Path) -> None:
    with (disk / "filler").open("wb", buffering=0) as stream:
        while stream.write(bytes(1 << 16)) == 1 << 16:
            if stream.tell() > 18 << 20:
                break
    done = run(sys.executable, program, WARP_CACHE_PATH=disk)
    assert "No space left on device; set the variable WARP_CACHE_PATH" in done.stdout
    assert done.stderr == ""
