"""Code that the pages show runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from coopenv.observers import run
from coopenv.observers.registry import find
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

DOCS = Path(__file__).parents[1] / "docs"


def test_the_tutorials_observer_runs() -> None:
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "observers.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "observers.md", "exec"), {})
    result = run(find("mine"), record(load_scenario("busy_intersection_tracking", {"horizon": 5.0}), 0))
    assert not result.failure
    # vehicles 1 to 3 see two landmarks and more, and turn towards them
    assert (result.orientation_error[-1, :3] < result.orientation_error[0, :3]).all()
    assert np.isfinite(result.position_error).all()
