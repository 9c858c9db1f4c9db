"""The stage table of `robust`: replacements of its functions have their arguments and results."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from benchmarks.stages.robust_stages import STAGES, wrapper
from coopenv.observers.robust.observer import fuse_messages, gate, set_bearing_measurements

ROOT = __file__.rsplit("/tests/", 1)[0]


def test_a_replacement_has_the_arguments_and_results_of_a_function() -> None:
    assert "    r0, r1, r2 = gate(frame, memory, world, i)\n" in wrapper(gate, 3)
    assert "    r0 = set_bearing_measurements(" in wrapper(set_bearing_measurements, 3)
    assert "    fuse_messages(" in wrapper(fuse_messages, 3) and "return" not in wrapper(fuse_messages, 3)


@pytest.mark.slow
def test_the_table_has_every_stage() -> None:
    command = [
        sys.executable,
        "-m",
        "benchmarks.stages.robust_stages",
        "--worlds",
        "8",
        "--start",
        "1",
        "--rounds",
        "2",
    ]
    table = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True).stdout
    rows = {name: values for name, *values in (re.split(r" {2,}", line.strip()) for line in table.splitlines()[2:])}
    assert set(rows) == {"all else", "sum", *(name for name, _ in STAGES)}
    assert all(float(rows[name][0]) > 0.0 for name in ("monitors", "iterated correction", "fusion"))
