"""The stages of a run, each with its own limit, in the order in which they matter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

SENSED = {"topology.mode": "sensed"}
ENVIRONMENT, TRAINED, LEARNING = "busy_intersection", "urban_crossing", "open_square"
CITY = {"streets.blocks": [19, 19], "vehicles.0.count": 922, "vehicles.1.count": 102}
"""1,024 vehicles in a world, at the density of the shipped city."""
OBSERVERS = ("riccati", "robust")
SIZES = (4_096, 16_384, 65_536, 262_144)


@dataclass(frozen=True)
class Stage:
    """A function of `benchmarks.gpu.work` that runs in a process of its own."""

    name: str
    """Name in tables."""
    work: str
    limit: float
    """s, after which it is ended."""
    arguments: dict[str, Any] = field(default_factory=dict)


def plan(device: str, sizes: tuple[int, ...] = SIZES, quick: bool = False) -> list[Stage]:
    """Return the stages of a run.

    Args:
        device: "cuda:0", or "cpu" to try the run itself.
        sizes: numbers of worlds whose throughput is measured.
        quick: as little as possible of everything.
    """
    stages = [Stage("machine", "machine", 30.0, {"device": device})]
    alike = {"worlds": 2, "decisions": 3} if quick else {"worlds": 64, "decisions": 30}
    pace = {"seconds": 0.1, "rounds": 2} if quick else {"seconds": 1.0, "rounds": 5}
    for observer, compiling in zip(OBSERVERS, (60.0, 180.0), strict=True):
        world = {"device": device, "environment": ENVIRONMENT, "overrides": {**SENSED, "observer.name": observer}}
        stages.append(
            Stage(f"compile, {observer}, float32", "compile_kernels", compiling, {**world, "dtype": "float32"})
        )
        for size in sizes:
            name = f"throughput, {observer}, {size}"
            stages.append(Stage(name, "throughput", 60.0, {**world, **pace, "worlds": size}))
        drawn = {**world, **pace, "environment": LEARNING, "overrides": {"observer.name": observer}}
        name = f"throughput, {observer} in {LEARNING}, {sizes[0]}"
        stages.append(Stage(name, "throughput", 60.0, {**drawn, "worlds": sizes[0]}))
        large = {**drawn, "environment": "city", "overrides": {**({} if quick else CITY), "observer.name": observer}}
        stages.append(Stage(f"throughput, {observer} in city, 1", "throughput", 90.0, {**large, "worlds": 1}))
        stages.append(
            Stage(f"compile, {observer}, float64", "compile_kernels", compiling, {**world, "dtype": "float64"})
        )
        stages.append(Stage(f"agreement, {observer}", "agreement", 120.0, {**world, **alike}))
    return [*stages, Stage("training", "training", 90.0, _training(device, quick)), _tests(device, quick)]


def _training(device: str, quick: bool) -> dict[str, Any]:
    size = {"num_worlds": 4096, "rollout": 16, "total_steps": 20_000_000, "evaluation_worlds": 256}
    if quick:
        size = {"num_worlds": 8, "rollout": 8, "total_steps": 512, "evaluation_worlds": 2}
    return {"env": TRAINED, "device": device, "log_every": 5, **size}


def _tests(device: str, quick: bool) -> Stage:
    chosen = "cpu and busy" if quick else device.split(":")[0]
    return Stage("tests", "tests", 90.0, {"files": ["tests/world/test_launch.py"], "chosen": chosen})
