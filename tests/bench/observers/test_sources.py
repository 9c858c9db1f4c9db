"""Where records come from: environments, recorded robots of the original file format, log files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.bench.observers import compare, find_source
from coopenv.bench.observers.faults import VARIANTS
from coopenv.bench.observers.sources import variants_of
from coopenv.cli.bench import ObserverOptions
from coopenv.observers import run
from coopenv.runs.recorder import record
from tests.helpers import mrclam_files


def test_a_log_file_gives_the_rows_of_what_it_recorded(tmp_path: Path) -> None:
    mcap = pytest.importorskip("mcap", reason="needs the extra log")
    assert mcap is not None
    from coopenv.backends.mcap import write_recording

    write_recording(record(coopenv.load_scenario("overtaking", {"horizon": 1.0}), 0), tmp_path / "drive.mcap")
    options: dict[str, Any] = {"variants": ["nominal", "v2x_delay"], "steady_from": 0.5}
    replay = compare(["mekf"], tmp_path / "drive.mcap", 3, **options)
    replayed = replay.rows
    simulated = compare(["mekf"], "overtaking", 1, overrides={"horizon": 1.0}, **options).rows
    assert (replay.environment, replay.seeds) == ("drive", (0,))
    assert [r.position_rmse_m for r in replayed] == [r.position_rmse_m for r in simulated]
    assert [r.bound_m for r in replayed] == [r.bound_m for r in simulated]


def test_variants() -> None:
    source = find_source("overtaking")
    assert variants_of(source, None) == ("nominal",) and variants_of(source, "all") == tuple(VARIANTS)
    assert variants_of(source, "v2x_loss, nominal,v2x_loss") == ("v2x_loss", "nominal")
    assert variants_of(find_source("mrclam_6"), None) == ("landmarks", "landmarks+robots", "blind")


def test_observers_are_compared_where_they_are_meant_to_be() -> None:
    """Unless they are asked for by name."""

    def names(source: str, observers: str | None = None) -> tuple[str, ...]:
        return ObserverOptions(source=source, observers=observers).plan().observers

    space, plane = names("overtaking"), names("mrclam_6")
    assert names("mrclam_6_space") == space
    assert not {"planar_ekf", "planar_robust"} & {*space} and {"p3p", "robust"} <= {*space}
    assert not {"p3p", "robust"} & {*plane} and {"planar_ekf", "planar_robust", "riccati"} <= {*plane}
    assert names("overtaking", "planar_ekf,mekf,mekf") == ("planar_ekf", "mekf")


@pytest.mark.parametrize("name", ["mrclam_6", "mrclam_6_space"])
def test_recorded_robots_have_rows_without_a_bound(tmp_path: Path, name: str) -> None:
    mrclam_files.write(tmp_path, seconds=15.0)
    source = find_source(name, data=tmp_path)
    rows = compare(["dead_reckoning", "mekf"], name, 4, data=tmp_path, variants=["landmarks", "blind"]).rows
    assert len(rows) == 2 * 2 * 5 and all(np.isnan(row.bound_m) and not row.failure for row in rows)
    assert all(np.isfinite([row.position_rmse_m, row.orientation_rmse_deg, row.ate_m]).all() for row in rows)
    # One record, judged from the start on: nothing was averaged over seeds, and nothing left out but the start itself.
    recording = source.recording("landmarks", 0)
    known = recording.truth.known & (recording.t > 0)[:, None]
    errors = run("dead_reckoning", recording).position_error
    expected = [np.sqrt(np.mean(errors[known[:, i], i] ** 2)) for i in range(5)]
    assert [row.position_rmse_m for row in rows[:5]] == pytest.approx(expected, rel=1e-12)
