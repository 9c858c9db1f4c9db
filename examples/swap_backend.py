"""Let the same lines and the same agent drive the simulation and two fake cars, and lay both drives over each other.

Needs the extra `svea`. Run: python examples/swap_backend.py (about half a minute; the figure is out/swap_backend.png)
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.cars.fake.fleet import fakes
from coopenv.policies import act, load_agent

FLEET = Path(__file__).with_name("fleet") / "overtaking.toml"


def make_env(backend=None, router=None):
    cars = {"deployment": FLEET, "connect": router} if backend == "svea" else {}
    return coopenv.parallel_env("svea_overtaking", backend=backend, **cars)


def drive(env, **options):
    driver = load_agent("route_follower", env.scenario)
    observations, infos = env.reset(seed=0, options=options)
    record = [infos]
    while env.agents:
        actions = act(driver, {agent: observations[agent] for agent in env.agents})
        observations, *_, infos = env.step(actions)
        record.append(infos)
    env.close()
    return record


simulated = drive(make_env())
with fakes(FLEET) as router:
    driven = drive(make_env("svea", router), arm=True)
for agent, info in {agent: info for infos in driven for agent, info in infos.items()}.items():
    print(f"{agent}, {info['car']['name']}: {info['outcome']}", info["car"]["stopped"])  # and why, if they were stopped


def poses(record, agent, whose):
    """Return time (K,) s, positions (K, 3) m and rotations (K, 3, 3) by the truth or the estimate."""
    infos = [infos[agent] for infos in record if agent in infos]
    places = [[info[whose][what] for info in infos] for what in ("position", "rotation")]
    return np.array([info["time"] for info in infos]), *(np.array(values, dtype=float) for values in places)


def apart(one, other):
    """Return how far poses are apart, m and deg, (K,) each; up to the end of the shorter list."""
    K = min(len(one[0]), len(other[0]))
    angles = Rotation.from_matrix(one[2][:K].swapaxes(-1, -2) @ other[2][:K]).magnitude()
    return np.linalg.norm(one[1][:K] - other[1][:K], axis=-1), np.degrees(angles)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


figure, (ways, errors) = plt.subplots(1, 2, figsize=(10, 5.5), width_ratios=[2, 3], layout="constrained")
scenario = coopenv.load_scenario("svea_overtaking")
for agent, colour in zip(scenario.vehicle_names, ("#0072B2", "#D55E00"), strict=True):
    for record, name, line in ((simulated, "simulation", "--"), (driven, "fake cars", "-")):
        truth, estimate = (poses(record, agent, whose) for whose in ("truth", "estimate"))
        ways.plot(*truth[1].T[:2], line, color=colour, label=f"{agent}, {name}")
        distance, angle = apart(truth, estimate)
        errors.semilogy(truth[0], 100.0 * distance, line, color=colour, lw=1, label=f"{agent}, {name}")
        steady = truth[0] > 2.0
        print(f"{agent}, {name}: RMSE {rms(distance[steady]):.4f} m, {rms(angle[steady]):.2f} deg after 2 s")
    distance, angle = apart(poses(simulated, agent, "truth"), poses(driven, agent, "truth"))
    print(f"{agent}: the drives are {rms(distance):.3f} m, {rms(angle):.2f} deg apart (RMS),", end=" ")
    print(f"at the end {distance[-1]:.3f} m, {angle[-1]:.2f} deg")
for landmark in scenario.landmarks:
    ways.plot(*landmark.position[:2], "s", color="#222222")
    ways.annotate(landmark.name, landmark.position[:2], (0, 6), textcoords="offset points", ha="center")
ways.set(xlabel="x [m]", ylabel="y [m]", title="True ways", aspect="equal", xlim=(-1.6, 1.6))
for name, line in (("simulation", "--"), ("fake cars", "-")):
    ways.plot([], [], line, color="#222222", label=name)
whose = [entries[-2:] for entries in ways.get_legend_handles_labels()]
ways.legend(*whose, loc="center", bbox_to_anchor=(0.5, 0.74))  # where nothing else is
errors.set(xlabel="t [s]", ylabel="error of the estimated position [cm]", title="What the cars know of it")
errors.legend()
Path("out").mkdir(exist_ok=True)
figure.savefig("out/swap_backend.png", dpi=130)
print("out/swap_backend.png")
