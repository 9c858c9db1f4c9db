"""highway-env: the environments of its list, each as the roads and the traffic of a scenario."""

# /// script
# dependencies = ["coopenv[highway]"]
# [tool.coopenv]
# package = "highway-env"
# documentation = "https://highway-env.farama.org/quickstart/"
# ///

import coopenv

NAMES = ("highway", "merge", "roundabout", "parking", "intersection", "racetrack", "exit", "two-way", "u-turn")

refused = []
for name in NAMES:
    overrides = {
        "highway.id": f"{name}-v0",
        "highway.most_vehicles": 60,
        "horizon": 5.0,
        "obstacles": [],
        "vehicles": [{"motion": {"kind": "driven"}}],
    }
    try:
        env = coopenv.parallel_env("highway_roundabout", overrides=overrides)
    except coopenv.CoopenvError as error:
        refused.append(f"{name} is refused ({error})")
        continue
    env.reset(seed=0)
    while env.agents:
        env.step({agent: [0.0, 0.0] for agent in env.agents})
    env.close()
print("; ".join([f"{len(NAMES) - len(refused)} of {len(NAMES)} environments run", *refused]))
