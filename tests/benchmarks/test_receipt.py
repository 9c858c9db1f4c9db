"""The table of what each part of `robust` buys."""

import numpy as np

from benchmarks.receipt import changes_of, constant_table, parts


def test_every_part_and_several_together_replace_what_exists() -> None:
    for part in parts():
        assert all(hasattr(module, name) for module, name, _ in changes_of(part))
    together = changes_of("readmission + prior+restarts when lost")
    assert [name for _, name, _ in together] == ["test_excluded", "own_fault_variance", "LOST_SHARE"]


def test_a_ratio_has_the_standard_error_over_the_seeds() -> None:
    values = np.array([1.0, 2.0, 4.0, 5.0])
    base = {"tracking: nominal": [2.0] * 4, "tracking: jump": [3.0] * 4}
    changed = {"tracking: nominal": list(values), "tracking: jump": [3.0] * 4}
    found = {"exclusions": 1.0, "hours": 2.0}
    shown = constant_table({"nothing": found | {"rmse": base}, "RISK*2": found | {"rmse": changed}})
    error = values.std(ddof=1) / 2.0 / 2.0  # of the mean of four, as a share of 2
    assert f"| 1.5({error * 10:.0f}) |" in shown.splitlines()[-1]
    assert "| tracking: jump | 0.5 |" in shown
