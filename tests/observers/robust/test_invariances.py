"""Invariances of an estimate: the map's axes and origin, the names of vehicles, a mirror, the frame rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from benchmarks.robust.worlds import watched
from coopenv.bench.observers.convergence import random_start
from coopenv.observers import Recording, run
from coopenv.observers.runner import Run
from coopenv.observers.sensed import Truth
from coopenv.scenario import load_scenario
from tests.helpers.robust_worlds import noise_free, small_errors

TURN, SHIFT = Rotation.from_rotvec([0.4, -0.7, 2.0]).as_matrix(), np.array([30.0, -80.0, 7.0])
MIRROR = np.diag([1.0, -1.0, 1.0])
AXIAL = -MIRROR
"""Effect of a mirror on an axis of rotation."""


def turned(recording: Recording, R: np.ndarray, t: np.ndarray) -> Recording:
    """Return the record on a map with other axes and another origin."""
    truth = recording.truth
    return replace(
        recording,
        landmarks=recording.landmarks @ R.T + t,
        start_rotation=R @ recording.start_rotation,
        start_position=recording.start_position @ R.T + t,
        truth=Truth(R @ truth.rotation, truth.position @ R.T + t),
    )


def mirrored(recording: Recording) -> Recording:
    """Return the record of the same world behind a mirror: left is right, for the map and for every body."""
    truth, M = recording.truth, MIRROR
    setups = [replace(s, lever_arm=M @ s.lever_arm, marker=M @ s.marker) for s in recording.setups]
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = AXIAL, MIRROR
    return replace(
        recording,
        setups=tuple(setups),
        rotation=M @ recording.rotation @ M,
        translation=recording.translation @ M,
        velocity=recording.velocity @ M,
        angular_velocity=recording.angular_velocity @ AXIAL,
        bearings=recording.bearings @ M,
        landmarks=recording.landmarks @ M,
        start_rotation=M @ recording.start_rotation @ M,
        start_position=recording.start_position @ M,
        start_covariance=both @ recording.start_covariance @ both,
        truth=Truth(M @ truth.rotation @ M, truth.position @ M),
    )


def renamed(recording: Recording, to: Sequence[int], backwards: bool = False) -> Recording:
    """Return the record in which vehicle n has the number to[n], with the targets of all in another order."""
    old = np.argsort(to)
    L, new = recording.setups[0].landmarks, np.asarray(to)
    targets = np.concatenate([np.arange(L), L + old])

    def setup(n: int) -> object:
        s = recording.setups[n]
        seen = np.where(s.targets < L, s.targets, L + new[np.maximum(s.targets - L, 0)])
        gains = replace(s.gains, q=s.gains.q[targets])
        names = tuple(s.target_names[t] for t in targets)
        return replace(
            s, vehicle=int(new[n]), targets=seen[::-1] if backwards else seen, gains=gains, target_names=names
        )

    def rows(values: np.ndarray) -> np.ndarray:
        return values[:, old]

    truth = recording.truth
    return replace(
        recording,
        setups=tuple(setup(int(n)) for n in old),
        order=tuple(int(new[n]) for n in recording.order),
        rotation=rows(recording.rotation),
        translation=rows(recording.translation),
        velocity=rows(recording.velocity),
        angular_velocity=rows(recording.angular_velocity),
        bearings=rows(recording.bearings)[:, :, targets],
        visible=rows(recording.visible)[:, :, targets],
        inbox_tick=rows(recording.inbox_tick)[:, :, old],
        start_rotation=recording.start_rotation[old],
        start_position=recording.start_position[old],
        start_covariance=recording.start_covariance[old],
        truth=Truth(rows(truth.rotation), rows(truth.position)),
    )


RECORDS = {
    "small errors": lambda: small_errors(6.0),
    "another start": lambda: random_start(noise_free(4.0), 1),
}


@pytest.fixture(params=RECORDS, scope="module")
def record(request: pytest.FixtureRequest) -> Recording:
    return RECORDS[request.param]()


@pytest.fixture(scope="module")
def result(record: Recording) -> Run:
    return run("robust", record)


def assert_same(got: Run, expected: Run, columns: Sequence[int] = range(5), within: float = 1e-6) -> None:
    """Assert that errors and their sizes are the same, but for rounding, which a search may amplify."""
    assert not got.failure
    columns = list(columns)
    late = slice(-60, None)
    assert_allclose(got.position_error[late][:, columns], expected.position_error[late], rtol=1e-4, atol=within)
    assert_allclose(got.nees[late][:, columns], expected.nees[late], rtol=1e-3, atol=1e-3)
    assert (got.nis_dof[late][:, columns] == expected.nis_dof[late]).all()


def test_axes_and_origin_of_the_map(record: Recording, result: Run) -> None:
    got = run("robust", turned(record, TURN, SHIFT))
    assert_same(got, result)
    assert_allclose(got.position[-1], result.position[-1] @ TURN.T + SHIFT, atol=1e-6)


def test_a_mirror(record: Recording, result: Run) -> None:
    got = run("robust", mirrored(record))
    assert_same(got, result)
    assert_allclose(got.position[-1], result.position[-1] @ MIRROR, atol=1e-6)


def test_names_of_vehicles_and_the_order_of_targets(record: Recording, result: Run) -> None:
    to = (3, 0, 4, 1, 2)
    assert_same(run("robust", renamed(record, to, True)), result, to, 1e-5)


def test_a_message_counts_once_however_often_it_comes() -> None:
    """All that is lost and all that comes again: without the news of others nothing is known better."""
    recording = small_errors(6.0)
    once = np.maximum.accumulate(recording.inbox_tick, axis=0)
    repeated = np.minimum(once, 40)  # from the 41st tick on the messages of that one come again and again
    stale = replace(recording, inbox_tick=np.where(once >= 0, repeated, -1), staleness=1e3)
    late = replace(stale, inbox_tick=np.where(np.arange(len(once))[:, None, None] > 42, -1, stale.inbox_tick))
    again, gone = run("robust", stale), run("robust", late)
    unseen = np.broadcast_to(
        np.arange(recording.bearings.shape[2]) < recording.setups[0].landmarks, recording.visible.shape
    )
    blind = [
        run("robust", replace(r, visible=r.visible & unseen, bearings=np.where(unseen[..., None], r.bearings, np.nan)))
        for r in (stale, late)
    ]
    assert_allclose(blind[0].covariance, blind[1].covariance, rtol=1e-9, atol=1e-15)
    size = [np.trace(r.covariance[-1, :, 3:, 3:], axis1=1, axis2=2) for r in (again, gone)]
    assert (size[0] > 0.3 * size[1]).all()


@pytest.mark.parametrize("name", ["busy_intersection_tracking", "lane:5"])
def test_half_the_frames_of_half_the_variance(name: str) -> None:
    """The information of a second is the same: so are the errors, on average, and how sure of them a vehicle is."""
    sizes = []
    for rate, factor in ((60.0, 1.0), (30.0, np.sqrt(0.5))):
        made = load_scenario(name, {"observer.name": "robust", "horizon": 20.0, "rates.odometry": 60.0})
        changes = {"rates.camera": rate, "noise.bearing.scale": made.noise.bearing.scale * factor}
        changes["v2x.period"] = max(1, round(made.v2x.period * rate / made.rates.camera))
        made = load_scenario(
            name,
            {"observer.name": "robust", "horizon": 20.0, "rates.odometry": 60.0, "rates.decision": 10.0, **changes},
        )
        nees, errors, _ = watched(made, range(300, 324), 12, round(made.rates.camera), skipped=4, dtype="float32")
        sizes.append((np.nanmean(nees), np.sqrt(np.nanmean(errors**2, axis=(0, 1)))))
    assert abs(sizes[0][0] - sizes[1][0]) < 0.35
    assert_allclose(sizes[1][1], sizes[0][1], rtol=0.35)
