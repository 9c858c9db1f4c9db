"""SUMO: its tutorial 'Hello SUMO', and the networks that its package has, as environments."""

# /// script
# dependencies = ["coopenv[sumo]"]
# [tool.coopenv]
# package = "eclipse-sumo"
# documentation = "https://sumo.dlr.de/docs/Tutorials/Hello_SUMO.html"
# ///

import subprocess
from pathlib import Path

import sumo

import coopenv

Path("hello.nod.xml").write_text(
    '<nodes><node id="1" x="-250" y="0"/><node id="2" x="250" y="0"/><node id="3" x="251" y="0"/></nodes>'
)
Path("hello.edg.xml").write_text('<edges><edge from="1" id="1to2" to="2"/><edge from="2" id="out" to="3"/></edges>')
Path("hello.rou.xml").write_text(
    '<routes><vType accel="1.0" decel="5.0" id="Car" length="2.0" maxSpeed="100.0" sigma="0.0"/>'
    '<route id="route0" edges="1to2 out"/><vehicle depart="1" id="veh0" route="route0" type="Car"/></routes>'
)
Path("hello.sumocfg").write_text(
    '<configuration><input><net-file value="hello.net.xml"/><route-files value="hello.rou.xml"/></input>'
    '<time><begin value="0"/><end value="10000"/></time></configuration>'
)
netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
made = (netconvert, "--node-files=hello.nod.xml", "--edge-files=hello.edg.xml", "--output-file=hello.net.xml")
subprocess.run(made, check=True, capture_output=True)

games = sorted((Path(sumo.SUMO_HOME) / "tools" / "game").glob("*.sumocfg"))
SCENARIO = """
title = "traffic of SUMO"
backend = "sumo"
horizon = 5.0
sumo = { net = "NET", warm_up = 25.0, most_vehicles = 500 }
topology.mode = "sensed"
rates = { camera = 10.0, odometry = 100.0, decision = 5.0 }
observer.name = "robust"
[camera]
model = "pinhole"
image_size = [1280, 800]
focal_length = [900.0, 900.0]
principal_point = [640.0, 400.0]
range = 60.0
[[vehicles]]
motion.kind = "traffic"
"""
configurations = (Path("hello.sumocfg").absolute(), *games)
refused = []
for config in configurations:
    Path("scene.toml").write_text(SCENARIO.replace("NET", str(config)))
    try:
        coopenv.run("scene.toml", seed=0)
    except coopenv.CoopenvError as error:
        refused.append(f"{config.name} is refused ({error})")
print("; ".join([f"{len(configurations) - len(refused)} of {len(configurations)} configurations run", *refused]))
