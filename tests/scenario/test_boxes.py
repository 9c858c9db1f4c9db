"""Boxes overlap where a linear programme finds a point in both."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from coopenv.scenario.routes import BLOCK, Boxes, boxes_overlap, overlapping_pairs


def drawn(rng: np.random.Generator, count: int, spread: float) -> Boxes:
    rotation = Rotation.random(count, random_state=rng.integers(2**31)).as_matrix()
    rotation[: count // 3] = np.eye(3)  # parallel edges
    return Boxes(rng.normal(0, spread, (count, 3)), rotation, rng.uniform(0.1, 2.0, (count, 3)))


def depth(a: Boxes, b: Boxes, n: int) -> float:
    """Return by how much the boxes would have to shrink on all sides to touch only; negative: to grow."""
    A = np.vstack([side * box.rotation[n].T for box in (a, b) for side in (1, -1)])
    limit = np.concatenate(
        [box.half[n] + side * (box.rotation[n].T @ box.center[n]) for box in (a, b) for side in (1, -1)]
    )
    solved = linprog([0, 0, 0, -1], A_ub=np.column_stack([A, np.ones(12)]), b_ub=limit, bounds=(None, None))
    return float(solved.x[3])


def test_against_linear_programmes() -> None:
    rng = np.random.default_rng(0)
    a, b = drawn(rng, 300, 1.5), drawn(rng, 300, 1.5)
    found = boxes_overlap(a, b)
    for n in range(300):
        d = depth(a, b, n)
        assert found[n] == (d > 0) or abs(d) < 1e-9, n
    assert 50 < found.sum() < 250


def test_pairs_are_found_block_by_block() -> None:
    rng = np.random.default_rng(1)
    a, b = drawn(rng, 900, 20.0), drawn(rng, 700, 20.0)
    assert len(a.half) * len(b.half) > 3 * BLOCK
    pairs = overlapping_pairs(a, b)
    expected = [
        (i, j)
        for i in range(900)
        for j in np.flatnonzero(boxes_overlap(Boxes(*(np.repeat(x[i : i + 1], 700, axis=0) for x in a)), b))
    ]
    assert [tuple(pair) for pair in pairs.tolist()] == expected
    assert len(expected) > 100
    own = overlapping_pairs(a, a)
    copied = overlapping_pairs(a, Boxes(*(x.copy() for x in a)))
    assert np.array_equal(own, copied[copied[:, 1] < copied[:, 0]])


def test_points_lie_in_boxes_or_not_and_never_in_one_another() -> None:
    point = Boxes(np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 3)))
    for x, inside in ((0.5, True), (1.5, False), (1.0, False)):
        box = Boxes(np.array([[x, 0.0, 0.0]]), Rotation.from_rotvec([[0.3, 0.0, 0.0]]).as_matrix(), np.ones((1, 3)))
        assert boxes_overlap(point, box).tolist() == [inside]
    assert not boxes_overlap(point, point).any()
    assert len(overlapping_pairs(point, Boxes(*(x[:0] for x in point)))) == 0
