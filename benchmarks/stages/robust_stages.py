"""`python -m benchmarks.stages.robust_stages [ENV]`: CPU time per vehicle tick of each stage of `robust`.

Functions of the observer are replaced by ones that read the processor's cycle counter before and after them. The time
of a stage is that of its functions without functions of other stages that they call.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import inspect
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.options import at_least, status_of
from coopenv.cli.options import load

STAGES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("odometry", ("take_odometry", "propagate_own")),
    ("messages", ("receive_broadcast", "send_broadcast")),
    ("fusion", ("fuse_messages",)),
    ("measurements", ("set_bearing_measurements",)),
    ("first linearisation", ("gate",)),
    ("iterated correction", ("iterated_update",)),
    ("monitors", ("correct_sources", "detect_and_exclude", "propagate_sources")),
    ("search", ("advance_search", "propagate_search")),
    ("protection level", ("write",)),
)
FOLDER = "coopenv.observers.robust"
TIMER = """
unsigned long long* a = (unsigned long long*){address}ull;
unsigned long long now = __builtin_readcyclecounter();
a[a[1]] += now - a[0];
a[0] = now;
int before = (int)a[1];
a[1] = stage;
return before;
"""
"""Entries of the counters: time of the last change, present stage, cycles of each stage from 2 on."""
OTHER = 2  # the stage of all else: the simulation, reports and the environment


def wrapper(function: Any, stage: int) -> str:
    """Return the source of a Warp function that counts the cycles of another one."""
    nodes = ast.walk(ast.parse(inspect.getsource(function.func)))
    returned = [node.value for node in nodes if isinstance(node, ast.Return) and node.value]
    names = list(inspect.signature(function.func).parameters)
    count = len(returned[0].elts) if returned and isinstance(returned[0], ast.Tuple) else min(len(returned), 1)
    results = ", ".join(f"r{n}" for n in range(count))
    call = f"{function.func.__name__}({', '.join(names)})"
    return f"""
@device_function
def timed_{function.func.__name__}({", ".join(f"{name}: Any" for name in names)}):
    before = change({stage})
    {results + " = " if results else ""}{call}
    change(before)
    {"return " + results if results else ""}
"""


def count_cycles(folder: Path) -> np.ndarray:
    """Replace the functions of all stages; return the counters."""
    import warp as wp

    from coopenv.observers.robust import observer

    modules = [module for name, module in sys.modules.items() if name.startswith(FOLDER)]
    counters = np.zeros(OTHER + 1 + len(STAGES), np.uint64)
    counters[1] = OTHER
    native = TIMER.format(address=counters.ctypes.data)
    text = [f"import warp as wp\nfrom typing import Any\nfrom {observer.__name__} import device_function\n"]
    text.append(f'@wp.func_native("""{native}""")\ndef change(stage: int) -> int: ...\n')
    found = {
        name: (stage, next(f for m in modules if isinstance(f := vars(m).get(name), wp.Function)))
        for stage, (_, names) in enumerate(STAGES, OTHER + 1)
        for name in names
    }
    text += [wrapper(function, stage) for stage, function in found.values()]
    path = folder / "timed.py"
    path.write_text("\n".join(text), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("timed", path)
    assert spec is not None and spec.loader is not None
    timed = importlib.util.module_from_spec(spec)
    sys.modules["timed"] = timed
    spec.loader.exec_module(timed)
    for name, (_, function) in found.items():
        for module in modules:
            if vars(module).get(name) is function:
                setattr(module, name, getattr(timed, f"timed_{name}"))
        setattr(timed, name, function)
    return counters


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stages.robust_stages", description=__doc__)
    parser.add_argument("environment", nargs="?", default="busy_intersection", metavar="ENV")
    parser.add_argument("--worlds", type=at_least(1), default=256)
    parser.add_argument("--start", type=at_least(0.0), default=10.0, help="s after which time counts (default: 10)")
    parser.add_argument(
        "--rounds", type=at_least(2), default=9, help="of which the mean and its standard error (default: 9)"
    )
    asked = parser.parse_args(arguments)
    return status_of(measure, asked)


def measure(asked: argparse.Namespace) -> None:
    """Measure and print."""
    overrides = {"observer.name": "robust", "topology.mode": "sensed"}
    load(asked.environment, overrides)  # a mistake is known before anything is replaced
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARP_CACHE_PATH"] = folder  # these kernels serve this process only
        import coopenv
        from coopenv.report.table import Table

        counters = count_cycles(Path(folder))
        env = coopenv.make_vec(asked.environment, num_worlds=asked.worlds, threads=1, overrides=overrides)
        env.reset(seed=0)
        rng, per_second = np.random.default_rng(0), round(env.scenario.rates.decision)
        rows = []
        for n in range(round(asked.start) + asked.rounds):
            begin, before = time.process_time(), counters.copy()
            for _ in range(per_second):
                env.step(rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32))
            spent = (time.process_time() - begin) / (per_second * env.scenario.ticks_per_decision * env.num_envs)
            cycles = (counters - before)[OTHER:].astype(float)
            if n >= round(asked.start):
                rows.append(1e9 * spent * cycles / cycles.sum())
    means, errors = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / len(rows) ** 0.5
    table = Table.of_texts([f"stage ({asked.environment})"], ["ns per tick", "standard error", "share"])
    names = [name for name, _ in STAGES]
    for name, mean, error in zip(["all else", *names], means, errors, strict=True):
        table.add(name, f"{mean:.0f}", f"{error:.0f}", f"{mean / means.sum():.2f}")
    table.add("sum", f"{means.sum():.0f}", "", "1.00")
    Console(markup=False, highlight=False).print(table)


if __name__ == "__main__":
    sys.exit(main())
