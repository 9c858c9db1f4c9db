"""The smoother against the batch solution and the filter; skipped where GTSAM is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import CoopenvError
from coopenv.observers import Coordinates, run
from coopenv.observers.registry import ZOO, available_names, find, observer_names
from tests.oracles.batch import assert_same_covariance, small_record


def test_a_missing_module_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ZOO, "factor_graph", replace(ZOO["factor_graph"], needs="no_such_module"))
    assert "factor_graph" in observer_names() and "factor_graph" not in available_names()
    with pytest.raises(CoopenvError, match=r"'factor_graph' needs no_such_module: pip install '.\[bench\]'"):
        find("factor_graph")


def test_of_bearings_at_key_frames_it_is_the_filter() -> None:
    """With small errors, what is most probable at the last frame does not depend on smoothing the others."""
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(12)  # 6 ticks of 60 Hz are one key frame
    visible = made.visible.copy()
    visible[[*range(1, 6), *range(7, 12)]] = False
    expected, result = (run(name, replace(made, visible=visible)) for name in ("left_invariant", "factor_graph"))
    assert not result.failure
    std = np.sqrt(expected.covariance[-1][:, range(6), range(6)])
    e = Coordinates.LEFT.error(expected.rotation[-1], expected.position[-1], result.rotation[-1], result.position[-1])
    assert_allclose(e / std, 0.0, atol=0.01)
    assert_same_covariance(result.covariance[-1], expected.covariance[-1])


def test_bearings_between_key_frames_count_as_well() -> None:
    """Of six equally good frames the mean has a sixth of the variance, if odometry between them is exact."""
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(6)
    exact = [replace(s, noise=replace(s.noise, velocity=1e-7, angular_velocity=1e-7)) for s in made.setups]
    made = replace(made, setups=tuple(exact))
    expected, result = run("left_invariant", made), run("factor_graph", made)
    assert_allclose(np.diag(result.covariance[-1, 0]), np.diag(expected.covariance[-1, 0]), rtol=0.01)
    std = np.sqrt(np.diag(expected.covariance[-1, 0]))
    e = Coordinates.LEFT.error(
        expected.rotation[-1, 0], expected.position[-1, 0], result.rotation[-1, 0], result.position[-1, 0]
    )
    assert_allclose(e / std, 0.0, atol=0.05)


def test_between_key_frames_it_is_dead_reckoning() -> None:
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(5)
    smoothed, reckoned = run("factor_graph", made), run("dead_reckoning", made)
    assert_allclose(smoothed.position, reckoned.position, atol=1e-12)


def test_nothing_seen_leaves_the_odometry_s_covariance() -> None:
    pytest.importorskip("gtsam", reason="needs the extra 'bench'")
    made = small_record(20)
    blind = replace(made, visible=np.zeros_like(made.visible))
    smoothed, reckoned = run("factor_graph", blind), run("dead_reckoning", blind)
    assert_allclose(smoothed.position, reckoned.position, atol=1e-6)
    assert_allclose(smoothed.covariance[-1], reckoned.covariance[-1], rtol=1e-3, atol=1e-12)
