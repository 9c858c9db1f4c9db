"""Work of the stages, each in a process of its own: `python -m benchmarks.gpu.work NAME JSON` prints a line of JSON."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks import machine as host
from benchmarks.speed.coopenv_cases import array_bytes
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.installation import versions
from coopenv.scenario import load_scenario
from coopenv.world.model import check_device

ROOT = Path(__file__).resolve().parents[2]
PROBE = 8
"""Worlds whose arrays tell how much memory one takes."""
FILLED = 0.8
"""Share of the free memory that a batch may take: kernels need some of their own."""
TOLERANCE = 1e-6
"""Largest |a - b| / (1 + |b|) of two computations in float64 that count as the same."""
BURST = 5
"""Steps between two looks at the clock."""


def machine(device: str) -> dict[str, Any]:
    """Return what a reader of the figures needs to know of machine and device."""
    found = wp.get_device(check_device(device))
    facts: dict[str, Any] = {"name": found.name, "memory_bytes": free_memory(device)}
    if found.is_cuda:
        facts |= {"memory_bytes": found.total_memory, "arch": found.arch, "multiprocessors": found.sm_count}
        facts |= {"cuda_toolkit": wp.get_cuda_toolkit_version(), "cuda_driver": wp.get_cuda_driver_version()}
    return {"host": host.machine(), "device": facts, "versions": versions("numpy", "warp-lang", "torch")}


def free_memory(device: str) -> int:
    """Return the bytes that a batch could take now."""
    found = wp.get_device(device)
    if found.is_cuda:
        return int(found.free_memory)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")


def compile_kernels(device: str, environment: str, overrides: dict[str, Any], dtype: str) -> dict[str, Any]:
    """Load the kernels of a precision, which compiles those that the cache does not hold."""
    begin = time.perf_counter()
    Engine(load_scenario(environment, overrides), 1, dtype, device).load()
    return {"seconds": time.perf_counter() - begin}


def agreement(device: str, environment: str, overrides: dict[str, Any], worlds: int, decisions: int) -> dict[str, Any]:
    """Step the same worlds under the same actions on the CPU and on the device, in float64.

    Where the device is the CPU, one thread is compared with two.
    """
    scenario = load_scenario(environment, overrides)
    second = (device, 2) if device == "cpu" else (device, None)
    engines = [Engine(scenario, worlds, "float64", where, threads) for where, threads in (("cpu", 1), second)]
    shape = engines[0].world.actions.shape
    generator = np.random.default_rng(0)
    for engine in engines:
        engine.reset(range(worlds))
    for _ in range(decisions):
        actions = generator.uniform(-1.0, 1.0, shape)
        for engine in engines:
            engine.step(actions)
    here, there = (engine.get_state() for engine in engines)
    return compared(here, there, worlds)


def compared(here: dict[str, Any], there: dict[str, Any], worlds: int) -> dict[str, Any]:
    """Return by how much two states differ at most, and in how many worlds they count as the same."""
    same, worst, where = np.ones(worlds, dtype=bool), 0.0, ""
    for name, expected in here.items():
        if not isinstance(expected, np.ndarray) or expected.shape[:1] != (worlds,):
            continue
        found = there[name]
        if expected.dtype.kind == "f":
            both = np.isfinite(expected) & np.isfinite(found)
            a, b = (np.where(both, values, 0.0) for values in (found, expected))
            difference = np.abs(a - b) / (1.0 + np.abs(b))
            difference[~both & ~((expected == found) | (np.isnan(expected) & np.isnan(found)))] = np.inf
        else:
            difference = np.where(found == expected, 0.0, np.inf)
        per_world = difference.reshape(worlds, -1).max(axis=1, initial=0.0)
        same &= per_world <= TOLERANCE
        if per_world.max() > worst:
            worst, where = float(per_world.max()), name
    return {"worlds": worlds, "worlds_alike": int(same.sum()), "largest_difference": worst, "in": where}


def throughput(
    device: str, environment: str, overrides: dict[str, Any], worlds: int, seconds: float, rounds: int
) -> dict[str, Any]:
    """Step a batch on the device, resets included, nothing of it copied to the host."""
    scenario = load_scenario(environment, overrides)
    each = array_bytes(Engine(scenario, PROBE, "float32", device)) / PROBE
    free = free_memory(device)
    if each * worlds > FILLED * free:
        return {"skipped": f"{worlds} worlds take {each * worlds / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free"}
    engine = Engine(scenario, worlds, "float32", device)
    engine.reset()
    engine.set_actions(np.random.default_rng(0).uniform(-1.0, 1.0, engine.world.actions.shape))
    rate_of(engine, 0.0)
    rates = [rate_of(engine, seconds) for _ in range(rounds)]
    median, vehicles = float(np.median(rates)), len(scenario.vehicles)
    return {
        "worlds": worlds,
        "bytes_per_world": each,
        "env_steps_per_s": median * worlds,
        "agent_steps_per_s": median * worlds * vehicles,
        "vehicle_ticks_per_s": median * worlds * vehicles * scenario.ticks_per_decision,
        "slowest_round": min(rates) / median,
        "fastest_round": max(rates) / median,
    }


def rate_of(engine: Engine, seconds: float) -> float:
    """Return the steps of the batch per second, over at least so much time."""
    wp.synchronize_device(engine.world.device)
    steps, begin = 0, time.perf_counter()
    while True:
        for _ in range(BURST):
            engine.step_or_restart()
        wp.synchronize_device(engine.world.device)
        steps, passed = steps + BURST, time.perf_counter() - begin
        if passed >= seconds:
            return steps / passed


def training(**options: Any) -> dict[str, Any]:
    """Train with `examples/train_ppo.py`; the fields of `options` are its arguments."""
    path = ROOT / "examples" / "train_ppo.py"
    spec = importlib.util.spec_from_file_location("train_ppo", path)
    assert spec is not None and spec.loader is not None
    example = sys.modules["train_ppo"] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(example)
    except ImportError as error:
        return {"skipped": f"needs the extra train: {error}"}
    begin = time.perf_counter()
    curve = example.train(example.Arguments(**options))
    wanted = ("return", "arrived", "collided", "position_error")
    first, last = ({key: row[key] for key in wanted} for row in (curve[0], curve[-1]))
    steps = curve[-1]["vehicle_steps"]
    rate = steps / max(curve[-1]["seconds"], 1e-9)
    return {
        **{key: options[key] for key in ("env", "num_worlds")},
        "vehicle_steps": steps,
        "steps_per_s": rate,
        "wall_s": time.perf_counter() - begin,
        "first": first,
        "last": last,
    }


def tests(files: list[str], chosen: str) -> dict[str, Any]:
    """Run those tests of some files whose names match an expression."""
    if importlib.util.find_spec("pytest") is None:
        return {"skipped": "needs pytest: pip install '.[dev]'"}
    import pytest

    class Count:
        """Number of tests by outcome."""

        def __init__(self) -> None:
            self.ends = {"passed": 0, "failed": 0, "left_out": 0}

        def pytest_runtest_logreport(self, report: Any) -> None:
            """Count the test itself, and what goes wrong before or after it."""
            if report.when == "call" or report.outcome != "passed":
                self.ends["left_out" if report.skipped else report.outcome] += 1

    count = Count()
    status = pytest.main(["-q", "-p", "no:cacheprovider", "-k", chosen, *(str(ROOT / f) for f in files)], [count])
    return {"status": int(status), **count.ends}


WORK: dict[str, Callable[..., dict[str, Any]]] = {
    work.__name__: work for work in (machine, compile_kernels, agreement, throughput, training, tests)
}
MARK = "RESULT "
"""Begins the line of the result; what libraries print comes before it."""


def main() -> int:
    """Do the work of a stage; return the exit status."""
    warnings.simplefilter("ignore")
    name, arguments = sys.argv[1:]
    try:
        result = WORK[name](**json.loads(arguments))
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"\n{MARK}{json.dumps(result)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
