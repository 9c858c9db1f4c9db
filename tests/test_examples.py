"""Examples that need other processes run from beginning to end."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests.helpers.processes import DEADLOCK, ROOT, mentioning, start

ATTEMPTS = 3
"""A computer that is busy with other things may stand still for so long that the watchdog stops the cars."""


@pytest.mark.slow
def test_an_agent_drives_the_simulation_and_cars(tmp_path: Path) -> None:
    for _ in range(ATTEMPTS):
        process = start((sys.executable, str(ROOT / "examples" / "swap_backend.py")), tmp_path)
        printed, errors = process.communicate(timeout=4 * DEADLOCK)
        assert process.returncode == 0, errors
        if "svea7: arrived" in printed:
            break
    rmse = [float(found) for found in re.findall(r"(?:simulation|fake cars): RMSE ([0-9.]+) m", printed)]
    assert len(rmse) == 4 and max(rmse) < 0.1
    ends = [float(found) for found in re.findall(r"at the end ([0-9.]+) m", printed)]
    assert len(ends) == 2 and max(ends) < 0.5
    assert (tmp_path / "out" / "swap_backend.png").stat().st_size > 20_000
    assert not mentioning(f"{ROOT / 'examples' / 'fleet'}")
