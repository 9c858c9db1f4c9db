"""Networks of SUMO, made here, and simulations without coopenv."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

CROSSING = "sumo_crossing"
EXACT = {"noise.enabled": False, "vehicles.*.initial_estimate": {"position_radius": 0.0, "orientation_angle": 0.0}}

TOML = """\
title = "my grid"
horizon = 60.0
backend = "sumo"
sumo = {{ net = "grid.net.xml", routes = ["grid.rou.xml"], warm_up = 30.0 }}
rates = {{ camera = 10.0, odometry = 100.0, decision = 5.0 }}
camera = {{ range = 60.0 }}
v2x = {{ range = 100.0, delay = 1 }}
topology = {{ mode = "sensed", most_nearby = 64 }}
observer.name = "riccati"

[vehicle_defaults]
body = {{ size = [5.0, 1.8, 1.5], center = [1.35, 0.0, 0.75] }}
marker = [1.35, 0.0, 1.5]
initial_estimate = {{ position_radius = 1.0, orientation_angle = 0.1 }}

[[vehicles]]
count = {count}
motion.kind = "traffic"
"""


def tool(name: str, *arguments: str, cwd: Path) -> None:
    """Run a tool of eclipse-sumo: a program such as netgenerate, or a script of its folder `tools`."""
    home = Path(pytest.importorskip("sumo", reason="needs the extra sumo").SUMO_HOME)
    script = name.endswith(".py")
    command = [sys.executable, str(home / "tools" / name)] if script else [str(home / "bin" / name)]
    environment = {**os.environ, "SUMO_HOME": str(home)}
    done = subprocess.run([*command, *arguments], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def grid(folder: Path, count: int, blocks: int = 3, *options: str) -> Path:
    """Write a grid of streets with two cars a second for 60 s, of which `count` are connected; return the scenario."""
    size = ("--grid.number", str(blocks + 1), "--grid.length", "100")
    tool("netgenerate", "--grid", *size, "--default.speed", "12", *options, "-o", "grid.net.xml", cwd=folder)
    trips = ("-e", "60", "-p", "0.5", "--seed", "1", "--prefix", "car", "--min-distance", "300")
    tool("randomTrips.py", "-n", "grid.net.xml", "-r", "grid.rou.xml", *trips, cwd=folder)
    path = folder / "grid.toml"
    path.write_text(TOML.format(count=count), encoding="utf-8")
    return path


ALONE = """
import json, sys
import libsumo

arguments, warm_up, steps = json.loads(sys.argv[1])
libsumo.start(["sumo", *arguments])
libsumo.simulationStep(warm_up)
for _ in range(steps):
    libsumo.simulationStep()
v = libsumo.vehicle
rows = {name: [*v.getPosition(name), v.getAngle(name), v.getSpeed(name)] for name in v.getIDList()}
print("ROWS" + json.dumps(rows))
"""


def own_simulation(folder: Path, seed: int, warm_up: float, steps: int, step: float = 0.1) -> dict[str, np.ndarray]:
    """Return x, y (m), angle (deg from north, clockwise) and speed (m/s) of all cars of the grid, without coopenv."""
    options = {
        "net-file": "grid.net.xml",
        "route-files": "grid.rou.xml",
        "step-length": step,
        "seed": seed,
        "collision.action": "none",
        "lanechange.duration": 2.0,
        "time-to-teleport": -1,
    }
    arguments = [f"--{key}={value}" for key, value in options.items()]
    command = [sys.executable, "-c", ALONE, json.dumps([arguments, warm_up, steps])]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("ROWS")]
    return {name: np.array(row) for name, row in json.loads(line.removeprefix("ROWS")).items()}
