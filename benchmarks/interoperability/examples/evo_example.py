"""evo: `evo_traj` and `evo_ape` of its front page, on trajectories that `coopenv run` and `export` write."""

# /// script
# dependencies = ["coopenv", "evo>=1.36"]
# [tool.coopenv]
# package = "evo"
# documentation = "https://github.com/MichaelGrupp/evo#command-line-interface"
# ///

import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent


def call(*command: str) -> str:
    """Run a program of this environment, and return what it prints."""
    return subprocess.run((str(BIN / command[0]), *command[1:]), check=True, capture_output=True, text=True).stdout


call("coopenv", "run", "busy_intersection", "--out", "drive", "--no-figures")
call("coopenv", "export", "drive", "--format", "tum", "--out", "tum")
files = sorted(Path("tum").glob("*"))
truth = next(file for file in files if "vehicle_1" in file.name and "truth" in file.name)
estimate = next(file for file in files if "vehicle_1" in file.name and "truth" not in file.name)
call("evo_traj", "tum", str(estimate), f"--ref={truth}")
stated = call("evo_ape", "tum", str(truth), str(estimate))
rmse = next(line.split()[1] for line in stated.splitlines() if line.strip().startswith("rmse"))
print(f"RMSE of vehicle_1 {float(rmse):.2f} m")
