"""A grid city of SUMO with 1,000 connected vehicles: write it, run it, and measure how fast it runs.

Run: python examples/sumo_city.py             (out/sumo_city/city.toml; then: coopenv describe out/sumo_city/city.toml)
     python examples/sumo_city.py --connected 5 100 500 1000    (ticks per second with so many connected vehicles)

Needs the extra `sumo`: its netgenerate makes the streets, its randomTrips.py the trips. All vehicles are on the road
from the first second on, at random places; those that are not connected hide and can be hit.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import sumo

from coopenv.api.engine import Engine
from coopenv.scenario import load_scenario

TOML = """\
title = "a grid city of SUMO"
horizon = 60.0
backend = "sumo"

[sumo]
net = "city.net.xml"
routes = ["city.rou.xml"]
warm_up = 5.0
most_vehicles = 2000

[rates]
camera = 10.0
odometry = 100.0
decision = 5.0

[camera]
model = "pinhole"
image_size = [1280, 800]
focal_length = [900.0, 900.0]
principal_point = [640.0, 400.0]
position = [2.0, 0.0, 1.3]
orientation = "forward"
range = 80.0

[topology]
mode = "sensed"
most_nearby = 128

[v2x]
delay = 1
range = 100.0

[vehicle_defaults]
body = {{ size = [5.0, 1.8, 1.5], center = [1.35, 0.0, 0.75] }}
marker = [1.35, 0.0, 1.5]
initial_estimate = {{ position_radius = 1.0, orientation_angle = 0.1 }}

[[vehicles]]
count = {count}
motion.kind = "traffic"
"""


def write_city(folder: Path, vehicles: int, junctions: int) -> None:
    """Write the network and the trips of so many vehicles, all of which depart within a second."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "SUMO_HOME": sumo.SUMO_HOME}
    tools = {"cwd": folder, "env": environment, "check": True, "stdout": subprocess.DEVNULL}
    streets = ["--grid", "--grid.number", str(junctions), "--grid.length", "150", "--default.speed", "12"]
    subprocess.run([f"{sumo.SUMO_HOME}/bin/netgenerate", *streets, "-o", "city.net.xml"], **tools)
    script = f"{sumo.SUMO_HOME}/tools/randomTrips.py"
    trips = ["-n", "city.net.xml", "-e", "1", "-p", str(1 / vehicles), "--min-distance", "1200", "--seed", "1"]
    where = ["--trip-attributes", 'departPos="random_free" departSpeed="max"', "-r", "city.rou.xml"]
    subprocess.run([sys.executable, script, *trips, *where], **tools)


def cpu_time() -> float:
    """Return the CPU time of the processes that this one has started and that run, s; 0 where /proc is missing."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    pids = children.read_text().split() if children.is_file() else []
    ticks = [int(x) for pid in pids for x in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]]
    return sum(ticks) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/sumo_city"))
    parser.add_argument("--vehicles", type=int, default=1200, help="on the road in all")
    parser.add_argument("--junctions", type=int, default=14, help="to a side")
    parser.add_argument("--connected", type=int, nargs="*", default=[1000])
    parser.add_argument("--observer", default="riccati")
    options = parser.parse_args()
    write_city(options.out, options.vehicles, options.junctions)
    print("connected  others  ticks/s  CPU of SUMO [ms/tick]  CPU of coopenv [ms/tick]  median error [m]")
    for count in options.connected:
        path = options.out / "city.toml"
        path.write_text(TOML.format(count=count), encoding="utf-8")
        engine = Engine(load_scenario(path, {"observer.name": options.observer}))
        engine.reset([1])
        others = int((engine.view("traffic_half")[0, :, 0] > 0).sum())
        for _ in range(100):  # 20 s
            engine.step()
        before, own, wall = cpu_time(), time.process_time(), time.perf_counter()
        for _ in range(50):
            engine.step()
        wall, own = time.perf_counter() - wall, time.process_time() - own
        sumo_time = cpu_time() - before
        present = engine.view("present")[0, engine.world.model.landmarks :] != 0
        error = np.median(engine.view("position_error")[0, present])
        costs = f"{100 / wall:8.1f} {10 * sumo_time:22.2f} {10 * own:25.2f}"
        print(f"{count:9} {others:7} {costs} {error:17.2f}", flush=True)
        engine.close()


if __name__ == "__main__":
    main()
