"""`make cuda-check`: what is compiled, what ptxas reports, what is kept, and which limits hold; without a GPU."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from benchmarks.cuda_check import (
    BEGIN,
    END,
    PRECISIONS,
    STACK,
    accept,
    assembler,
    beyond,
    catalogue,
    check_module,
    limits,
    parsed,
    put,
)
from coopenv.base.errors import CoopenvError
from coopenv.observers.registry import ZOO

SMALL, ELF_OF_CUDA = "coopenv.host.float32", 190


def has_ptxas() -> bool:
    try:
        return bool(assembler())
    except CoopenvError:
        return False


needs_ptxas = pytest.mark.skipif(not has_ptxas(), reason="needs ptxas: make cuda-check installs it")


def checked(out: Path, *arguments: str) -> list[dict[str, Any]]:
    """Return the rows of a check whose limits hold, of a process of its own.

    In this one, modules also have kernels of the tests that have run before.
    """
    command = [sys.executable, "-m", "benchmarks.cuda_check", *arguments, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads((out / "cuda_check.json").read_text())["rows"]
    return rows


@pytest.fixture(scope="module")
def modules() -> dict[str, Any]:
    return catalogue("float32")


def test_every_module_has_limits(modules: dict[str, Any]) -> None:
    assert {name.removeprefix("coopenv.") for p in PRECISIONS for name in catalogue(p)} == set(limits())
    for name in (name for name, entry in ZOO.items() if entry.kernels):
        assert any(name in module for module in modules), name


def test_parts_of_robust_stay_small() -> None:
    """Bytes of PTX stand for the time to compile: 1.2 MB take 20 s."""
    parts = [needs for name, needs in limits().items() if name.startswith("robust")]
    assert len(parts) == 6 * len(PRECISIONS)
    assert max(needs["stack"] for needs in parts) < STACK
    assert max(needs["ptx_bytes"] for needs in parts) < 2_000_000


def test_the_most_demanding_kernel_counts() -> None:
    report = """
ptxas info    : Compiling entry function 'a' for 'sm_90'
ptxas info    : Function properties for a
    0 bytes stack frame, 8 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 40 registers, used 0 barriers
ptxas info    : Compiling entry function 'b' for 'sm_90'
ptxas info    : Function properties for b
    96 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 32 registers, used 0 barriers, 720 bytes cumulative stack size
ptxas info    : Function properties for of_b
    0 bytes stack frame, 16 bytes spill stores, 16 bytes spill loads
"""
    assert parsed(report) == {"registers": 40, "stack": 720, "spills": 32}
    with pytest.raises(CoopenvError, match="no kernel"):
        parsed("ptxas info    : 0 bytes gmem")


def test_what_is_above_a_limit_is_a_line() -> None:
    row = {"module": "a", "arch": 90, "ptx_bytes": 10, "registers": 255, "stack": 100, "spills": 0}
    allowed = {"ptx_bytes": 10, "registers": 255, "stack": 100, "spills": 0}
    assert not beyond([row], {"a": allowed})
    assert beyond([row], {"a": {**allowed, "stack": 99}}) == ["a, sm_90: stack 100, at most 99"]
    assert beyond([row, row], {}) == ["a: no limits in cuda_limits.csv"]


def test_rows_of_a_part_replace_their_own_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, csv = tmp_path / "page.md", tmp_path / "limits.csv"
    csv.write_text(
        "module,ptx_bytes,registers,stack,spills\nb.float32,1,2,3,4\nc.float32,1,2,3,4\ngone.float32,1,2,3,4\n"
    )
    monkeypatch.setattr("benchmarks.cuda_check.LIMITS", csv)
    page.write_text(
        f"above\n{BEGIN}\n\n| module | x |\n|---|---|\n| `b` | 9 |\n| `c` | 9 |\n| `gone` | 9 |\n\n{END}\nbelow\n"
    )
    needs = {"ptx_bytes": 100, "registers": 250, "stack": 2000, "spills": 8}
    rows = [{"module": "b.float32", "arch": 90, "ptx_s": 1.0, "ptxas_s": 1.0, **needs}]
    accept(rows, {"b.float32", "c.float32"})
    put(rows, page, {"b.float32", "c.float32"})
    assert limits() == {
        "b.float32": {"ptx_bytes": 125, "registers": 255, "stack": STACK - 1, "spills": 10},
        "c.float32": {"ptx_bytes": 1, "registers": 2, "stack": 3, "spills": 4},
    }
    text = page.read_text()
    assert text.startswith(f"above\n{BEGIN}\n\n| module | compile [s] |") and text.endswith(f"{END}\nbelow\n")
    assert "\n| `b` | 2 | 250 | 2000 | 8 |\n| `c` | 9 |\n" in text and "gone" not in text


@needs_ptxas
def test_code_is_where_warp_looks_for_it_and_is_made_once(modules: dict[str, Any], tmp_path: Path) -> None:
    """An interrupted run goes on with the architecture that is missing; what is there is not compiled again."""
    module, ptxas = modules[SMALL], assembler()
    rows = check_module(module, tmp_path, [80], ptxas)
    name = module.get_module_identifier()
    code = (tmp_path / name / f"{name}.sm80.cubin").read_bytes()
    assert code[:4] == b"\x7fELF" and int.from_bytes(code[18:20], "little") == ELF_OF_CUDA
    assert (tmp_path / name / f"{name}.meta").exists()
    assert check_module(module, tmp_path, [80], "no ptxas") == rows
    both = check_module(module, tmp_path, [80, 90], ptxas)
    assert both[0] == rows[0] and [row["arch"] for row in both] == [80, 90]
    shutil.rmtree(tmp_path / name)
    assert check_module(module, tmp_path, [80], ptxas)[0]["registers"] == rows[0]["registers"]


@needs_ptxas
def test_limits_hold_and_records_are_not_copied(tmp_path: Path) -> None:
    """The records of a world have 9 kB; a thread that moves it has far less."""
    pattern = rf"{SMALL}|coopenv.dead_reckoning.float32"
    rows = checked(tmp_path, "--only", pattern, "--dtype", "float32", "--arch", "80", "90")
    stacks = {row["module"]: row["stack"] for row in rows}
    assert len(rows) == 4 and stacks["dead_reckoning.float32"] < 1000


@needs_ptxas
def test_limits_of_parts_of_robust_hold(tmp_path: Path) -> None:
    """Their loops over matrices are where registers run out first: a third 6x6 matrix doubled the stack."""
    assert len(checked(tmp_path, "--only", "robust_(correct|fuse)", "--dtype", "float32", "--arch", "90")) == 2


@pytest.mark.slow
@needs_ptxas
def test_all_limits_hold_on_one_architecture(tmp_path: Path) -> None:
    assert len(checked(tmp_path, "--arch", "90")) == len(limits())
    assert len([*(tmp_path / wp.config.version).glob("wp_coopenv.*/*.sm90.cubin")]) == len(limits())
