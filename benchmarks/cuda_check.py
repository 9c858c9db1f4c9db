"""`make cuda-check`: compile every kernel for three GPUs on a machine without one, and hold what each thread needs.

Warp's compiler (NVRTC) writes PTX for the oldest architecture. NVIDIA's assembler `ptxas`, from PyPI, makes the code of
each architecture and counts registers, stack and spills. The folder of the results is a cache of Warp: with
`WARP_CACHE_PATH` set to it, a machine with such a GPU compiles nothing. A run goes on where an earlier one has ended.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from itertools import product
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.options import at_least
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, shown
from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.report.table import markdown
from coopenv.scenario import load_scenario
from coopenv.sources.feed import COSIMULATED, RECORDED
from coopenv.world.launch import Launcher, PerWorld, kernel
from coopenv.world.model import precision
from coopenv.world.step import source_kernels

ROOT = Path(__file__).resolve().parents[1]
LIMITS, PAGE = Path(__file__).with_name("cuda_limits.csv"), ROOT / "docs" / "cuda.md"
ARCHITECTURES, PRECISIONS = (80, 90, 100), ("float32", "float64")
CASES: tuple[dict[str, Any], ...] = (
    {"observer.name": "riccati", "reward.team": "min"},
    {"observer.name": "riccati", "observer.k": 2.0},
    {"observer.name": "dead_reckoning"},
    {"observer.name": "robust"},
    {"observer.name": "mekf"},
)
"""Overrides of `ENVIRONMENT` with every observer that has kernels, and with one on the host."""
ENVIRONMENT = "urban_crossing"
NEEDS = ("ptx_bytes", "registers", "stack", "spills")
"""Limited quantities. Seconds have no limits, as they depend on the machine; the size of the PTX stands for them."""
ROOM, REGISTERS = 1.25, 16
"""Margin of limits over the values of `--accept`: a factor, and registers; architectures differ by as much."""
STACK = 2048
"""B of stack per thread; a limit reaches it only where the need does."""
BEGIN, END = "<!-- make cuda-check: begin -->", "<!-- make cuda-check: end -->"
ENTRY = re.compile(r"Compiling entry function '(\w+)'.*?(?=Compiling entry function|\Z)", re.DOTALL)
Rows = list[dict[str, Any]]


class Recorder(Launcher):
    """Notes the modules of the kernels that it would launch."""

    def __init__(self, precision_name: str, lanes: int, modules: dict[str, Any]) -> None:
        super().__init__(1, "cpu", precision_name, lanes=lanes)
        self._modules = modules

    def _record(self, function: Any, arguments: list[Any], *where: Any) -> Any:
        """Note a kernel, with the overload that its arguments need; a launch of it does nothing."""
        found = kernel(function, self._precision)
        if found.is_generic:
            values = [a.value if isinstance(a, PerWorld) else a for a in arguments]
            found.add_overload(found.infer_argument_types(values))
        self._modules[found.module.name] = found.module
        return lambda: None


def catalogue(precision_name: str) -> dict[str, Any]:
    """Return the Warp modules of `CASES`, and those of recorded and cosimulated ticks, by name."""
    modules: dict[str, Any] = {}
    for source in (RECORDED, COSIMULATED):
        modules |= {k.module.name: k.module for k in source_kernels(source, precision(precision_name)).values()}
    for overrides, lanes in product(CASES, (1, 2)):  # a thread per world, or several
        engine = Engine(load_scenario(ENVIRONMENT, overrides), 1, precision_name)
        engine.world.launch = Recorder(precision_name, lanes, modules)
        engine.world.in_parts = len(engine.world.observer.parts) > 1  # as on a GPU
        engine.load()
        engine.refresh()
        engine.close()
    return modules


def assembler() -> str:
    """Return the path of `ptxas`. Raises CoopenvError: it is not installed."""
    try:
        files = metadata.files("nvidia-cuda-nvcc") or []
    except metadata.PackageNotFoundError:
        files = []
    for found in (Path(str(file.locate())) for file in files if file.name == "ptxas"):
        found.chmod(0o755)  # wheels may lose it
        return str(found)
    raise CoopenvError("ptxas is not installed: pip install --no-deps nvidia-cuda-nvcc")


def write_ptx(module: Any, folder: Path) -> tuple[Path, float]:
    """Return the PTX of a module, compiled where it is not there yet, and the s of CPU time that it took."""
    begin = time.thread_time()
    (ptx,) = wp.compile_aot_module(module, arch=min(ARCHITECTURES), module_dir=folder, use_ptx=True)
    text = ptx.read_bytes()
    ptx.write_bytes(text.rstrip(b"\0"))  # Warp writes the end of the string, which ptxas refuses
    return ptx, time.thread_time() - begin


def assemble(ptx: Path, arch: int, ptxas: str) -> dict[str, Any]:
    """Write the code of an architecture beside a PTX; return what its most demanding kernel needs."""
    code = ptx.with_name(f"{ptx.name.split('.sm')[0]}.sm{arch}.cubin")
    command = [ptxas, f"-arch=sm_{arch}", "--verbose", str(ptx), "-o", str(code)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        code.unlink(missing_ok=True)
        raise CoopenvError(f"ptxas, {ptx.name}, sm_{arch}: {said.strip().splitlines()[-1]}")
    return {**parsed(said), "ptxas_s": usage.ru_utime + usage.ru_stime, "cubin_bytes": code.stat().st_size}


def parsed(said: str) -> dict[str, int]:
    """Return registers, bytes of stack and bytes of spills of the most demanding kernel that ptxas has reported on."""
    kernels = [part.group(0) for part in ENTRY.finditer(said)]
    if not kernels:
        raise CoopenvError("ptxas: no kernel in its report")
    stacks = [_numbers(r"(\d+) bytes cumulative stack size", part) for part in kernels]
    frames = [_numbers(r"(\d+) bytes stack frame", part)[:1] for part in kernels]
    spills = [sum(_numbers(r"(\d+) bytes spill (?:stores|loads)", part)) for part in kernels]
    registers = [max(_numbers(r"Used (\d+) registers", part)) for part in kernels]
    return {
        "registers": max(registers),
        "stack": max(max(stack or frame) for stack, frame in zip(stacks, frames, strict=True)),
        "spills": max(spills),
    }


def _numbers(pattern: str, text: str) -> list[int]:
    return [int(number) for number in re.findall(pattern, text)]


def module_name(module: Any) -> str:
    """Return the name of a Warp module in tables."""
    return str(module.name.split("coopenv.")[-1])


def check_module(module: Any, out: Path, architectures: Sequence[int], ptxas: str) -> Rows:
    """Return a row per architecture, from the folder of the module where an earlier run has left it."""
    folder = out / module.get_module_identifier()
    kept = folder / "cuda_check.json"
    known: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    ptx, seconds = write_ptx(module, folder)
    known.setdefault("ptx_s", seconds)
    known["ptx_bytes"] = ptx.stat().st_size
    for arch in architectures:
        if str(arch) not in known:
            known[str(arch)] = assemble(ptx, arch, ptxas)
            replace_text(kept, json_text(known))
    common = {"module": module_name(module), **{key: known[key] for key in ("ptx_s", "ptx_bytes")}}
    return [{**common, "arch": arch, **known[str(arch)]} for arch in architectures]


def check(modules: Iterable[Any], out: Path, architectures: Sequence[int], jobs: int) -> Iterator[Rows]:
    """Yield the rows of each module, in turn; several are compiled at a time."""
    ptxas = assembler()
    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(lambda module: check_module(module, out, architectures, ptxas), modules)


def limits() -> dict[str, dict[str, int]]:
    """Return the limits of `NEEDS` by module."""
    with LIMITS.open(encoding="utf-8", newline="") as stream:
        return {row["module"]: {name: int(row[name]) for name in NEEDS} for row in csv.DictReader(stream)}


def beyond(rows: Rows, allowed: dict[str, dict[str, int]]) -> list[str]:
    """Return a line for every need of a module above its limit, and for a module that has none."""
    lines = [f"{row['module']}: no limits in {LIMITS.name}" for row in rows if row["module"] not in allowed]
    for row in (row for row in rows if row["module"] in allowed):
        for name, most in allowed[row["module"]].items():
            if row[name] > most:
                lines.append(f"{row['module']}, sm_{row['arch']}: {name} {row[name]}, at most {most}")
    return list(dict.fromkeys(lines))


def accept(rows: Rows, known: Collection[str]) -> None:
    """Write the limits that the modules of rows need, with room, beside those of the others that are known.

    A thread has 255 registers at most.
    """
    allowed = {name: limit for name, limit in limits().items() if name in known}
    for name in {row["module"] for row in rows}:
        most = {need: max(row[need] for row in rows if row["module"] == name) for need in NEEDS}
        room = {need: round(ROOM * most[need]) for need in NEEDS}
        room["registers"] = min(255, most["registers"] + REGISTERS)
        if most["stack"] < STACK:
            room["stack"] = min(room["stack"], STACK - 1)
        allowed[name] = room
    lines = [("module", *NEEDS), *((name, *map(str, room.values())) for name, room in sorted(allowed.items()))]
    replace_text(LIMITS, "".join(f"{','.join(line)}\n" for line in lines))


def report(rows: Rows) -> str:
    """Return the table of the page: a row per module, the most of both precisions and all architectures."""
    cells = []
    for name in sorted({row["module"].rpartition(".")[0] for row in rows}):
        own = [row for row in rows if row["module"].rpartition(".")[0] == name]
        most = {key: max(row[key] for row in own) for key in own[0] if key not in ("module", "arch")}
        seconds = f"{most['ptx_s'] + most['ptxas_s']:.0f}"
        cells.append([f"`{name}`", seconds, *(str(most[key]) for key in ("registers", "stack", "spills"))])
    return markdown(["module", "compile [s]", "registers", "stack [B]", "spills [B]"], cells)


def put(rows: Rows, page: Path, known: Collection[str]) -> None:
    """Put the table into a page between its two marks; rows of other modules that are known stay."""
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    old, _, after = rest.partition(END)
    head, rule, *new = report(rows).splitlines()
    lines = {line.split("`")[1]: line for line in (*old.splitlines(), *new) if line.startswith("| `")}
    names = {name.rpartition(".")[0] for name in known}
    text = "\n".join([head, rule, *(line for name, line in sorted(lines.items()) if name in names)])
    replace_text(page, f"{before}{BEGIN}\n\n{text}\n\n{END}{after}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile and print; return the exit status: 0, 1 where a limit is broken, 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    warnings.simplefilter("ignore")
    rows: Rows = []
    try:
        if asked.accept and (len({*asked.dtype}), len({*asked.arch})) != (len(PRECISIONS), len(ARCHITECTURES)):
            raise CoopenvError("--accept needs both precisions and all architectures: leave out --dtype and --arch")
        known = {name: module for p in asked.dtype for name, module in catalogue(p).items()}
        modules = [module for name, module in known.items() if asked.only.search(name)]
        if not modules:
            raise CoopenvError(f"--only: no module has '{asked.only.pattern}' in its name")
        cache = asked.out / wp.config.version  # as Warp makes it of WARP_CACHE_PATH
        for found in check(modules, cache, asked.arch, asked.jobs):
            rows += found
            print(f"{found[0]['module']}: " + "; ".join(_line(row) for row in found), flush=True)
        if asked.accept:
            names = {module_name(module) for module in known.values()}
            accept(rows, names)
            put(rows, PAGE, names)
        broken = beyond(rows, limits())
    except (CoopenvError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    replace_text(asked.out / "cuda_check.json", json_text({"rows": rows}))
    print(f"\n{report(rows)}\n\n{asked.out}: code for Warp's cache (WARP_CACHE_PATH), and cuda_check.json")
    if broken:
        print("\n".join(broken), file=sys.stderr)
    return 1 if broken else 0


def _line(row: dict[str, Any]) -> str:
    return f"sm_{row['arch']} {row['registers']} registers, {row['stack']} B of stack, {row['spills']} B of spills"


def pattern(text: str) -> re.Pattern[str]:
    """Return a regular expression."""
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f"expected a regular expression, got {shown(text)}: {error}") from None


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.cuda_check", description=__doc__)
    found.add_argument("--arch", type=int, nargs="+", default=list(ARCHITECTURES), choices=ARCHITECTURES)
    found.add_argument("--dtype", nargs="+", default=list(PRECISIONS), choices=PRECISIONS)
    found.add_argument(
        "--only", type=pattern, default="", metavar="PATTERN", help="modules whose names match a regular expression"
    )
    found.add_argument("--out", type=Path, default=Path("out", "cuda"), help="folder of the code (default: out/cuda)")
    found.add_argument("--jobs", type=at_least(1), default=os.cpu_count() or 1, help="modules at a time")
    found.add_argument("--accept", action="store_true", help="make limits, and rows of the page's table, of this run")
    return found


if __name__ == "__main__":
    sys.exit(main())
