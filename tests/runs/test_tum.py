"""TUM files say the poses of the run, and evo reads the same errors from them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.runs.recorder import write_tum
from tests.helpers.synthetic import make_trajectory


def test_a_line_is_a_pose(tmp_path: Path) -> None:
    run = make_trajectory(ticks=121, noise=0.02, yaw_rate=0.3)
    gone = run.position_estimate.copy()
    gone[50:60, 1] = np.nan
    run = dataclasses.replace(run, position_estimate=gone)
    paths = write_tum(run, tmp_path / "tum")
    assert [path.name for path in paths[:2]] == ["vehicle_1_truth.tum", "vehicle_1_estimate.tum"]
    assert len(paths) == 10
    rows = np.loadtxt(paths[1])
    np.testing.assert_allclose(rows[:, 0], run.t, atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:4], run.position_estimate[:, 0], atol=1e-9)
    turned = Rotation.from_quat(rows[:, 4:]).as_matrix()
    np.testing.assert_allclose(turned, run.rotation_estimate[:, 0], atol=1e-8)
    assert len(np.loadtxt(paths[3])) == 111


def test_evo_measures_the_same_errors(tmp_path: Path) -> None:
    pytest.importorskip("evo", reason="needs evo: pip install evo")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    run = make_trajectory(ticks=301, noise=0.05)
    truth, estimate, *_ = write_tum(run, tmp_path)
    reference, found = (file_interface.read_tum_trajectory_file(str(path)) for path in (truth, estimate))
    pair = sync.associate_trajectories(reference, found)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    np.testing.assert_allclose(ape.error, run.position_error[:, 0], atol=1e-7)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turn.process_data(pair)
    np.testing.assert_allclose(turn.error, run.orientation_error[:, 0], atol=1e-5)
