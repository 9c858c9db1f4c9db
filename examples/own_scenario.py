"""Change a scenario: how much does the radio's delay cost the last vehicle of the chain?

Run: python examples/own_scenario.py (about 10 s)
"""

from pathlib import Path

import coopenv
from coopenv.runs import rollout

for delay in (0, 6, 30):
    overrides = {"v2x.delay": delay, "v2x.loss": 0.0, "v2x.staleness": 2.0, "horizon": 10.0}
    scenario = coopenv.load_scenario(Path(__file__).with_name("four_way.toml"), overrides)
    run = rollout(scenario, seed=0)
    late = run.t > 5.0
    error = (run.position_error[late] ** 2).mean(axis=0) ** 0.5
    print(f"delay {delay / scenario.rates.camera:4.2f} s:", " ".join(f"{100 * e:5.1f} cm" for e in error))
